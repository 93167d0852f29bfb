"""The pulse: who is slow is given time, who stands still is noticed."""

from __future__ import annotations

import time

import pytest

from catstream.services.pulse import PATIENCE, Pulse


@pytest.fixture
def pulse():
    pulse = Pulse()
    yield pulse
    pulse.close()


def test_who_watches_sees_each_turn(pulse):
    loop = Pulse(pulse.handle)
    for turn in range(1, 4):
        loop.beat()
        assert pulse.turns == turn
    assert pulse.patience == PATIENCE


def test_who_is_starting_has_longer_than_who_turns(pulse):
    assert pulse.patience > 20 * PATIENCE


def test_a_long_step_that_is_announced_has_its_time_and_the_next_has_not(pulse):
    pulse.beat()
    pulse.allow(60)
    assert pulse.patience == 60
    pulse.beat()
    assert pulse.patience == PATIENCE


def test_where_turns_are_slow_patience_is_longer_until_they_are_quick_again(pulse, monkeypatch):
    clock = [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    for seconds in (0.0, 0.0, 4.0):
        clock[0] += seconds
        pulse.beat()
    assert pulse.patience == pytest.approx(20, rel=0.1)
    for _ in range(500):
        pulse.beat()
    assert pulse.patience == PATIENCE
