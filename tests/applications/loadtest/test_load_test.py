"""Real runs: pipelines on a camera that does not wait, also if they are ended early."""

import subprocess
import time

import psutil
import pytest

from catstream.applications.loadtest.latency import REST, Usage
from catstream.applications.loadtest.load_test import Limit, Plan, run_load_test, violations


@pytest.fixture
def sleeper():
    child = subprocess.Popen(["sleep", "600"])
    yield child
    child.kill()
    child.wait()


def children():
    """Processes of this one, but for the start server and the resource tracker, which stay to its end."""
    servers = ("services.start_server", "resource_tracker")
    stay = [child for child in psutil.Process().children() if any(name in str(child.cmdline()) for name in servers)]
    return [child for child in psutil.Process().children(recursive=True) if child not in stay]


def test_usage_shows_which_process_is_busy(sleeper):
    usage, busy = Usage(), psutil.Process().pid
    usage.read({"busy": [busy], "idle": [sleeper.pid]})
    deadline = time.process_time() + 0.3
    while time.process_time() < deadline:
        pass
    usage.read({"busy": [busy], "idle": [sleeper.pid]})
    assert usage.readings["idle"][0][0] < usage.readings["busy"][0][0]
    assert usage.readings[REST][0][0] >= 0
    assert 0 < usage.readings["idle"][0][1] < usage.readings["busy"][0][1]


def test_an_interrupted_run_returns_its_measurements_and_leaves_no_process():
    def tell(_, share, figures):
        if share > 0.05 and "tracks" in figures:
            raise KeyboardInterrupt

    plan = Plan(rate=20.0, duration=20.0, size=(320, 240))
    load_test = run_load_test(plan, [Limit("p99", 60.0)], find=False, report=tell)
    assert load_test.interrupted
    assert load_test.violations == []
    (stream,) = load_test.result.streams
    assert 10 <= stream.frames < plan.frames
    assert stream.frames == len(stream.track)
    assert load_test.result.seconds == pytest.approx(stream.frames / 20)
    assert stream.totals["sent"] == stream.totals["stored"] > stream.frames  # what it learned before counts too
    assert children() == []


def test_a_still_before_the_first_frame_is_not_taken_for_it_at_a_low_rate():
    load_test = run_load_test(Plan(rate=1.0, duration=1.0, size=(64, 64)), [], find=False)
    (stream,) = load_test.result.streams
    assert stream.track[0] > 0


@pytest.mark.slow
def test_a_search_ends_with_a_rate_that_meets_the_limits_below_one_that_does_not():
    plan = Plan(rate=30.0, duration=3.0, size=(320, 240))
    load_test = run_load_test(plan, [Limit("p99", 1.0), Limit("skipped", 0.05)], find=True)
    held = {step.plan.rate for step in load_test.results if not violations(load_test.limits, step)}
    assert load_test.highest_rate in held
    assert load_test.result.plan.rate == max(held)
    assert any(violations(load_test.limits, step) for step in load_test.results) or load_test.highest_rate == 1000.0
