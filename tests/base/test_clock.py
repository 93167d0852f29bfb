"""Time limits while the process itself is stopped."""

import pytest

import catstream
from catstream.base import clock
from catstream.errors import SilenceError


def test_clock_skips_the_time_in_which_its_process_was_stopped(monkeypatch):
    moments = iter([1000.0, 1000.2, 1000.4, 4000.0, 4000.1])
    monkeypatch.setattr(clock, "monotonic", lambda: next(moments))
    running = clock.RunningClock()
    assert [running() for _ in range(4)] == pytest.approx([0.2, 0.4, 0.4 + clock.STEP_SECONDS, 1.0])


def test_stopped_subscriber_waits_for_the_rest_of_its_timeout(folder, monkeypatch):
    looks = []

    def read():
        """The clock of a process that is stopped for an hour between two of the times."""
        looks.append(0.1 * len(looks) + 3600 * (len(looks) > 20))
        return looks[-1]

    monkeypatch.setattr(clock, "monotonic", read)
    with catstream.subscribe(str(folder), "tracks", timeout=5) as tracks, pytest.raises(SilenceError):
        next(tracks)
    assert len(looks) > 40
