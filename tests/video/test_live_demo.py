"""The demo as a live source: it never ends, and skips frames that are read late."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.errors import VideoError
from catstream.video import live_demo, rendered
from catstream.video.source import open_source


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until `clock.now` is changed."""

    class Clock:
        now = 100.0

    monkeypatch.setattr(live_demo, "monotonic", lambda: Clock.now)
    return Clock


def read(source, clock, seconds):
    """The frame that is read some seconds later."""
    clock.now += seconds
    return next(source)


def test_live_demo_begins_with_its_first_image(clock):
    with open_source("demo:1") as source:
        clock.now += 3600
        first = next(source)
    image, _ = rendered.Demo((320, 240), seed=1).image(60)
    assert (first.number, first.time, source.counters) == (0, 0.0, {"skipped": 0})
    assert np.array_equal(first.image, image)


def test_late_frames_are_skipped_and_counted(clock):
    with open_source("demo:1") as source:
        frames = [next(source), read(source, clock, 0.041), read(source, clock, 0.2)]
        assert [frame.number for frame in frames] == [0, 1, 2]
        assert source.counters == {"skipped": 4}
        assert np.array_equal(frames[2].image, source._image(6))
        assert frames[2].time == pytest.approx(0.241)


def test_live_demo_runs_forwards_and_backwards_without_end(clock):
    with open_source("demo:1") as source:
        first = next(source).image
        again = read(source, clock, 2 * 124 / 25 + 0.001)
        assert again.number == 1
        assert np.array_equal(again.image, first)
        assert len(source._images) == 1, "an image that is never shown is not rendered"


def test_later_start_continues_with_the_image_of_its_number(clock):
    with open_source("demo:1") as whole, open_source("demo:1", start=3, since=90.0) as later:
        frame = next(later)
        assert (frame.number, frame.time, frame.pts) == (3, 10.0, 3 / 25)
        assert list(later._images) == [3], "the images before it are not rendered"
        next(whole)
        assert np.array_equal(frame.image, read(whole, clock, 0.121).image)


def test_idle_function_or_close_ends_iteration(clock):
    with open_source("demo:1", idle=lambda: True, image_rate=1.0) as source:
        next(source)
        assert next(source, None) is None
    clock.now += 10
    assert next(source, None) is None


@pytest.mark.parametrize("text", ["demo:", "demo:x", "demo:-1", "demo:1?rate=10"])
def test_invalid_live_demo_is_an_error_with_an_example(text):
    with pytest.raises(VideoError, match="is not a live demo: expected demo:SEED, for example demo:1"):
        open_source(text)
