"""Limits and plans, and real runs: pipelines on a camera that does not wait, also if they are ended early."""

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.settings import Settings
from catstream.errors import ServiceError, SettingsError
from catstream.measure import load_test as module
from catstream.measure.latency import Receipts
from catstream.measure.load_report import to_json
from catstream.measure.load_result import Limit, Plan, violations
from catstream.measure.load_test import find_highest, run_load_test


def children():
    """Processes of this one, but for the start server and the resource tracker, which stay to its end."""
    servers = ("processes.start_server", "resource_tracker")
    stay = [child for child in psutil.Process().children() if any(name in str(child.cmdline()) for name in servers)]
    return [child for child in psutil.Process().children(recursive=True) if child not in stay]


def test_interrupted_run_returns_its_measurements():
    def tell(_, share, figures):
        if share > 0.05 and "tracks" in figures:
            raise KeyboardInterrupt

    plan = Plan(rate=20.0, duration=20.0, size=(320, 240), source="h264")
    load_test = run_load_test(plan, [Limit("p99", 60.0)], report=tell)
    assert load_test.interrupted
    assert load_test.sustained is None
    (stream,) = load_test.result.streams
    assert 10 <= len(stream.due) < plan.frames
    assert len(stream.due) == len(stream.track)
    assert load_test.result.seconds == pytest.approx(len(stream.due) / 20)
    assert stream.totals["sent"] == stream.totals["stored"] > len(stream.due)  # including the frames before the run
    assert children() == []


def test_still_before_a_run_is_not_its_first_frame():
    settings = Settings(run={"endpoint": "run"})  # is ignored: each stream of a load test has its own endpoint
    load_test = run_load_test(Plan(rate=1.0, duration=1.0, size=(64, 64), settings=settings), [])
    (stream,) = load_test.result.streams
    assert stream.track[0] > 0


@pytest.fixture
def machine(monkeypatch, result):
    """Simulates a machine that serves `capacity` streams, and starts `most`; the second run of `flaky` fails."""

    def made(capacity, most=1000, flaky=None, find="streams"):
        tried = []

        def run(plan, *_):
            number = getattr(plan, find)
            if number > most:
                tried.append(number)
                raise ServiceError("it took too long")
            tracked = 1.0 if number <= capacity and not (number == flaky and number in tried) else 0.9
            tried.append(number)
            run = result(*[[0.01] * 50] * plan.streams, tracked=tracked)
            run.plan = plan
            return run

        monkeypatch.setattr(module, "run", run)
        monkeypatch.setattr(module, "prepare", lambda *_: None)
        return tried

    return made


@pytest.mark.parametrize(
    ("find", "facts", "plan", "steps", "highest"),
    [
        ("streams", {"capacity": 6}, {}, [1, 2, 4, 8, 6, 7, 6], 6),
        ("streams", {"capacity": 99}, {"streams": 40}, [40, 64, 64], 64),
        ("streams", {"capacity": 0}, {"streams": 2}, [2, 1], None),
        ("streams", {"capacity": 6, "flaky": 6}, {}, [1, 2, 4, 8, 6, 7, 6, 5, 5], 5),
        ("rate", {"capacity": 160}, {"rate": 29.97}, [30, 60, 120, 240, 180, 150, 165, 157, 161, 157], 157),
        ("subscribers", {"capacity": 160}, {}, [50, 100, 200, 150, 175, 162, 156, 156], 156),
    ],
)
def test_search_bisects_and_confirms_the_highest_number(machine, find, facts, plan, steps, highest):
    tried = machine(**facts, find=find)
    load_test = run_load_test(Plan(**plan), [Limit("skipped", 0.0)], find=find)
    assert (tried, load_test.highest) == (steps, highest)
    assert getattr(load_test.result.plan, find) == (highest or 1)
    assert load_test.sustained == bool(highest)
    assert to_json(load_test, {})["highest"] == highest


def test_streams_that_do_not_start_are_a_step_but_not_the_first(machine):
    machine(capacity=6, most=4)
    assert run_load_test(Plan(), [], find="streams").refused == dict.fromkeys((8, 6, 5), "it took too long")
    machine(capacity=6, most=0)
    with pytest.raises(ServiceError, match="it took too long"):
        run_load_test(Plan(), [], find="streams")


def test_limit_applies_to_the_worst_stream(result):
    run = result([0.01] * 100, [0.01] * 90 + [0.2] * 10)
    assert violations([Limit("p99", 0.1)], run) == ["p99 is 200 ms, limit at most 100 ms (from a frame to its track)"]
    assert violations([Limit("p99", 0.2), Limit("p50", 0.01), Limit("max", 0.2), Limit("success", 0.9)], run) == []
    assert "success is 0.9, limit at least 0.95" in violations([Limit("success", 0.95)], run)[0]


def test_default_limits_allow_skipped_frames_in_the_warm_up():
    assert Limit.defaults(Plan()) == [Limit("p99", 0.1), Limit("skipped", 0.0)]
    assert Limit.defaults(Plan(warm_up=True)) == [Limit("p99", 0.1), Limit("skipped", 0.01)]
    assert Limit("subscriber-missed", 0.0) in Limit.defaults(Plan(), find="subscribers")


def test_failed_stream_is_a_violation_beside_missed_frames(result):
    receipts = Receipts(0, "tracks", np.full((2, 10), 0.02), received=[99, 99], missed=[1, 1])
    run = result([0.01] * 10, subscribers=[receipts], errors=["stream 0: it died"])
    assert violations([Limit("subscriber-missed", 0.01), Limit("subscriber-p99", 0.02)], run) == ["stream 0: it died"]
    assert "limit at most 0.009" in violations([Limit("subscriber-missed", 0.009)], run)[1]
    assert "subscriber-p99 is 20 ms" in violations([Limit("subscriber-p99", 0.019)], run)[1]


@pytest.mark.parametrize("text", ["p98=0.1", "p99", "p99=fast", "p99=-1", "p99=nan"])
def test_malformed_limit_is_an_error(text):
    with pytest.raises(SettingsError, match=r"NAME=VALUE with one of p50, .*for example p99=0\.1"):
        Limit.parse(text)


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"rate": 0.5, "duration": 0.9}, "no frame is due"),
        ({"size": (321, 240), "source": "h264"}, "an even width"),
        ({"settings": Settings(run={"lockstep": True})}, "omit run.lockstep"),
        ({"slow_subscribers": 1}, "more slow subscribers"),
    ],
)
def test_contradictory_plan_is_an_error(facts, message):
    with pytest.raises(SettingsError, match=message):
        Plan(**facts)


@given(st.integers(1, 64), st.integers(0, 80))
def test_search_finds_the_highest_number_within_5_percent(start, capacity):
    tried = []

    def holds(streams):
        tried.append(streams)
        return streams <= capacity

    found, highest = find_highest(start, holds, most=64) or 0, min(capacity, 64)
    assert 0.95 * highest <= found <= highest
    assert len(tried) <= 13
    assert tried.count(found) == (2 if found else 0)
    assert all(1 <= streams <= 64 for streams in tried)
