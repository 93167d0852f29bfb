"""The reason of the end of a process: the first one, unless the source fails."""

import os
import signal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.processes.ending import Ending
from catstream.wire.messages import End

REASONS = st.lists(st.tuples(st.sampled_from(["the source has ended", "it was stopped"]), st.booleans()), max_size=4)


@pytest.fixture(autouse=True)
def handlers():
    """The handlers of this process are put back after the test."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@given(REASONS)
def test_first_reason_counts_and_a_failure_is_never_hidden(reasons):
    ending = Ending()
    for reason, failed in reasons:
        ending.begin(reason, failed=failed)
    assert bool(ending.reason) == bool(reasons)
    assert ending.failed == any(failed for _, failed in reasons)
    assert (ending.ended, ending.signalled) == (False, False)
    if reasons and not ending.failed:
        assert ending.reason == reasons[0][0]


def test_signal_is_a_reason_and_its_time_is_of_the_first_one():
    ending = Ending()
    assert ending.seconds_since_signal < 0
    os.kill(os.getpid(), signal.SIGTERM)
    first = ending.seconds_since_signal
    assert (ending.reason, ending.signalled, ending.ended) == ("it was stopped", True, False)
    os.kill(os.getpid(), signal.SIGINT)
    assert ending.seconds_since_signal >= first >= 0


def test_received_end_ends_a_process_with_its_reason():
    ending = Ending()
    ending.receive(End(2, "cannot decode frame 2", failed=True))
    assert (ending.reason, ending.failed, ending.ended) == ("cannot decode frame 2", True, True)
