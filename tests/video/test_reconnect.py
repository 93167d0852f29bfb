"""The table of reconnections, by histories of losses."""

from __future__ import annotations

from typing import get_args

import pytest

from catstream.video.reconnect import Attempt, Kind, Loss, next_attempt

#: Losses, as kinds with the number of frames, and the attempts that follow: how each begins, and its mode.
HTTP = {
    "a camera that restarts": (
        [("ended", 90), ("failed", 0), ("ended", 50)],
        [("backoff", "parsed"), ("backoff", "parsed"), ("backoff", "parsed")],
    ),
    "a still picture": ([("ended", 1), ("ended", 1)], [("poll", "parsed"), ("poll", "parsed")]),
    "JPEGs that probing rejects": (
        [("invalid", 0), ("ended", 90), ("failed", 0)],
        [("at once", "jpegs"), ("backoff", "jpegs"), ("backoff", "jpegs")],
    ),
    "JPEGs that probing waits for": (
        [("silent", 0), ("silent", 90), ("silent", 0)],
        [("at once", "jpegs"), ("backoff", "jpegs"), ("backoff", "jpegs")],
    ),
    "a page": ([("invalid", 0), ("invalid", 0), ("invalid", 0)], [("at once", "jpegs"), ("backoff", "parsed")] * 2),
    "a text part between JPEGs": ([("invalid", 79)], [("at once", "jpegs")]),
    "a camera that is silent": ([("silent", 90), ("silent", 0)], [("backoff", "parsed"), ("backoff", "parsed")]),
    "another kind of camera": (
        [("invalid", 0), ("ended", 9), ("invalid", 0), ("ended", 9)],
        [("at once", "jpegs"), ("backoff", "jpegs"), ("backoff", "parsed"), ("backoff", "parsed")],
    ),
}
RTSP = {
    "H.265": ([("invalid", 0), ("ended", 90)], [("at once", "parsed"), ("backoff", "parsed")]),
    "a camera that is silent from the start": ([("silent", 0)] * 2, [("at once", "parsed"), ("backoff", "rtp")]),
    "a camera that is silent": ([("silent", 90), ("silent", 0)], [("backoff", "rtp")] * 2),
}
MODES = {"http": ("parsed", "jpegs"), "rtsp": ("rtp", "parsed"), "rtmp": ("parsed",)}


def attempts(losses, protocol="http"):
    """The attempts after each of the losses."""
    modes, result = MODES[protocol], []
    attempt = Attempt(modes[0])
    for kind, frames in losses:
        attempt = next_attempt(attempt, Loss(kind, frames), modes)
        result.append(attempt)
    return result


@pytest.mark.parametrize(
    ("protocol", "losses", "expected"),
    [(protocol, *each) for protocol, table in (("http", HTTP), ("rtsp", RTSP)) for each in table.values()],
    ids=[*HTTP, *(f"RTSP: {name}" for name in RTSP)],
)
def test_next_attempt_follows_from_the_losses(protocol, losses, expected):
    following = [(attempt.begin, attempt.mode) for attempt in attempts(losses, protocol)]
    assert following == expected[: len(losses)]


@pytest.mark.parametrize("losses", [losses for losses, _ in HTTP.values()], ids=HTTP)
def test_other_protocols_are_neither_polled_nor_read_as_jpegs(losses):
    assert {(attempt.begin, attempt.mode) for attempt in attempts(losses, "rtmp")} == {("backoff", "parsed")}


def test_backoff_doubles_up_to_a_limit_until_a_frame():
    refused = [("failed", 0)]
    assert [attempt.backoff for attempt in attempts(7 * refused)] == [0.25, 0.5, 1, 2, 4, 8, 8]
    assert [attempt.backoff for attempt in attempts([*refused, *refused, ("ended", 9), *refused])][2:] == [0.25, 0.5]
    assert attempts(5000 * refused)[-1].backoff == 8


@pytest.mark.parametrize("kind", get_args(Kind))
@pytest.mark.parametrize("frames", [0, 1, 90])
def test_at_most_one_attempt_is_made_at_once(kind, frames):
    assert "at once" not in {attempt.begin for attempt in attempts([("invalid", 0), (kind, frames)])[1:]}
