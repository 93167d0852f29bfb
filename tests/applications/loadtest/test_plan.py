"""Limits and plans: what must hold, told in words, and what makes no sense refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.applications.loadtest.load_test import KINDS, Limit, Plan, find_highest_rate, violations
from catstream.errors import ObjectError, SettingsError
from catstream.settings import Settings


def test_a_limit_applies_to_the_worst_stream(result):
    run = result([0.01] * 100, [0.01] * 90 + [0.2] * 10)
    assert violations([Limit("p99", 0.1)], run) == ["p99 is 200 ms, limit at most 100 ms (from a frame to its track)"]
    assert violations([Limit("p99", 0.2), Limit("p50", 0.01), Limit("max", 0.2)], run) == []


def test_the_limit_on_success_is_a_minimum(result):
    run = result([0.01], success=0.8)
    assert violations([Limit("success", 0.8)], run) == []
    assert "limit at least 0.9" in violations([Limit("success", 0.9)], run)[0]


def test_skipped_and_missed_are_shares_and_a_failed_stream_is_a_violation_in_any_case(result):
    run = result([0.01] * 10, followed=0.9, received=[99, 99], missed=[1, 1], errors=["stream 0: it died"])
    assert violations([Limit("skipped", 0.1), Limit("missed", 0.01)], run) == ["stream 0: it died"]
    assert len(violations([Limit("skipped", 0.09), Limit("missed", 0.009)], run)) == 3


@pytest.mark.parametrize("name", KINDS)
def test_every_limit_can_be_parsed_and_described(name, result):
    limit = Limit.parse(f"{name}=0.5")
    assert Limit.parse(str(limit)) == limit
    assert limit.describe(result([0.25])).startswith(f"{name} is ")


@pytest.mark.parametrize("text", ["p98=0.1", "p99", "p99=", "p99=fast", "p99=-1", "p99=nan", "p99=inf", "=1", ""])
def test_a_malformed_limit_is_an_error(text):
    with pytest.raises(SettingsError, match=r"NAME=VALUE with one of p50, .*for example p99=0\.1"):
        Limit.parse(text)


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"subscribers": 3, "slow_subscribers": 4}, "4 of 3 subscribers cannot be slow"),
        ({"rate": 0.5, "duration": 0.9}, "no frame is due"),
        ({"objects": 99}, "shows at most 16 objects, not 99"),
        ({"settings": Settings(run={"lockstep": True})}, "leave out lockstep"),
        ({"settings": Settings(run={"endpoint": "run"})}, "leave out endpoint"),
    ],
)
def test_a_contradictory_plan_is_an_error(facts, said):
    with pytest.raises(SettingsError, match=said):
        Plan(**facts)


def test_a_plan_has_at_most_as_many_objects_as_the_settings_allow():
    assert "8 objects" in str(Plan(objects=8))
    with pytest.raises(ObjectError, match="8 objects are more than 4"):
        Plan(objects=8, settings=Settings(run={"objects_most": 4}))


@given(st.floats(0.5, 1000), st.floats(0.5, 1000))
def test_the_search_is_within_5_percent_of_the_highest_rate_and_tries_each_rate_once(start, capacity):
    step_done = []

    def holds(rate):
        step_done.append(rate)
        return rate <= capacity

    found = find_highest_rate(start, holds)
    assert found <= capacity <= max(found * 1.05 + 0.1, 1000 * (found == 1000))
    assert len(step_done) == len(set(step_done)) <= 18
    assert find_highest_rate(start, lambda _: False) is None
