"""Time limits while the process itself is stopped."""

import pytest

import catstream
from catstream.base import clock
from catstream.errors import SilenceError
from catstream.messages.kinds import Command
from catstream.wire.channels import CONTROL
from catstream.wire.commands import Requester
from catstream.wire.endpoint import Endpoint


def test_a_clock_does_not_count_the_time_in_which_the_process_was_stopped(monkeypatch):
    moments = iter([1000.0, 1000.2, 1000.4, 4000.0, 4000.1])
    monkeypatch.setattr(clock, "monotonic", lambda: next(moments))
    running = clock.RunningClock()
    assert [running() for _ in range(4)] == pytest.approx([0.2, 0.4, 0.4 + clock.STEP_SECONDS, 1.0])


@pytest.fixture
def looks(monkeypatch):
    """How often a clock was read, in a process that is stopped for an hour between two of the times."""
    moments = []

    def read():
        moments.append(0.1 * len(moments) + 3600 * (len(moments) > 20))
        return moments[-1]

    monkeypatch.setattr(clock, "monotonic", read)
    return moments


def test_a_subscriber_that_was_stopped_waits_for_the_rest_of_its_timeout(folder, looks):
    with catstream.subscribe(str(folder), "tracks", timeout=5) as tracks, pytest.raises(SilenceError):
        next(tracks)
    assert len(looks) > 40


def test_a_command_of_a_process_that_was_stopped_waits_for_the_rest_of_its_timeout(folder, looks):
    with Requester(CONTROL, Endpoint.parse(str(folder))) as requester:
        assert requester.ask(Command("1", "pause"), 5) is None
    assert len(looks) > 40
