"""The table of reconnections, by histories of losses."""

from __future__ import annotations

from typing import get_args

import pytest

from catstream.video.reconnect import Attempt, Kind, Loss, next_attempt

#: A history of losses, as kinds with the number of frames, and the attempts that follow: how each begins, its demuxer.
HTTP = {
    "a camera that restarts": (
        [("ended", 90), ("failed", 0), ("ended", 50)],
        [("backoff", None), ("backoff", None), ("backoff", None)],
    ),
    "a still picture": ([("ended", 1), ("ended", 1)], [("poll", None), ("poll", None)]),
    "JPEGs that probing rejects": (
        [("invalid", 0), ("ended", 90), ("failed", 0)],
        [("at once", "mjpeg"), ("backoff", "mjpeg"), ("backoff", "mjpeg")],
    ),
    "JPEGs that probing waits for": (
        [("silent", 0), ("silent", 90), ("silent", 0)],
        [("at once", "mjpeg"), ("backoff", "mjpeg"), ("backoff", "mjpeg")],
    ),
    "a page": ([("invalid", 0), ("invalid", 0), ("invalid", 0)], [("at once", "mjpeg"), ("backoff", None)] * 2),
    "a text part between JPEGs": ([("invalid", 79)], [("at once", "mjpeg")]),
    "a camera that is silent": ([("silent", 90), ("silent", 0)], [("backoff", None), ("backoff", None)]),
    "another kind of camera": (
        [("invalid", 0), ("ended", 9), ("invalid", 0), ("ended", 9)],
        [("at once", "mjpeg"), ("backoff", "mjpeg"), ("backoff", None), ("backoff", None)],
    ),
}


def attempts(losses, *, is_http=True):
    """The attempts after each of the losses."""
    attempt, result = Attempt(), []
    for kind, frames in losses:
        attempt = next_attempt(attempt, Loss(kind, frames), is_http=is_http)
        result.append(attempt)
    return result


@pytest.mark.parametrize(("losses", "expected"), HTTP.values(), ids=HTTP)
def test_the_next_attempt_follows_from_the_history(losses, expected):
    following = [(attempt.begin, attempt.demuxer) for attempt in attempts(losses)]
    assert following == expected[: len(losses)]


@pytest.mark.parametrize("losses", [losses for losses, _ in HTTP.values()], ids=HTTP)
def test_only_http_is_polled_or_read_by_the_other_demuxer(losses):
    assert {(attempt.begin, attempt.demuxer) for attempt in attempts(losses, is_http=False)} == {("backoff", None)}


def test_the_backoff_doubles_up_to_a_limit_until_a_frame_arrives():
    refused = [("failed", 0)]
    assert [attempt.backoff for attempt in attempts(7 * refused)] == [0.25, 0.5, 1, 2, 4, 8, 8]
    assert [attempt.backoff for attempt in attempts([*refused, *refused, ("ended", 9), *refused])][2:] == [0.25, 0.5]
    assert attempts(5000 * refused)[-1].backoff == 8


@pytest.mark.parametrize("kind", get_args(Kind))
@pytest.mark.parametrize("frames", [0, 1, 90])
def test_reconnection_pauses_after_at_most_one_immediate_attempt(kind, frames):
    """A source that cannot be read is not asked again and again without a pause."""
    assert "at once" not in {attempt.begin for attempt in attempts([("invalid", 0), (kind, frames)])[1:]}
