"""Real runs: pipelines on a camera that does not wait, ended early, and under chaos."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from multiprocessing import resource_tracker

import psutil
import pytest

from catstream.applications.loadtest.chaos import Chaos
from catstream.applications.loadtest.limits import Limit, violations
from catstream.applications.loadtest.load_test import run_load_test
from catstream.applications.loadtest.plan import Plan
from catstream.applications.loadtest.usage import REST, Usage


class Sleepers:
    """What chaos kills, in place of a stream."""

    def __init__(self) -> None:
        self.children = {name: self.start() for name in ("detector", "compressor", "trainer")}

    def start(self):
        return subprocess.Popen(["sleep", "600"])

    @property
    def pids(self):
        return {name: child.pid for name, child in self.children.items() if child.poll() is None}

    def close(self):
        for child in self.children.values():
            child.kill()
            child.wait()


@pytest.fixture
def sleepers():
    streams = [Sleepers(), Sleepers()]
    yield streams
    for stream in streams:
        stream.close()


def children():
    """Processes of this one, but for the two servers that stay to its end."""
    tracker = getattr(resource_tracker._resource_tracker, "_pid", None)
    own = [child for child in psutil.Process().children() if child.pid != tracker]
    family = own + [process for child in own for process in child.children(recursive=True)]
    return [process for process in family if not is_start_server(process)]


def is_start_server(process):
    try:
        return process.name() == "start server"
    except psutil.Error:  # it has ended
        return True


def test_chaos_records_the_processes_that_it_kills(sleepers):
    chaos = Chaos(seed=7)
    for _ in range(3):
        chaos._due = 0.0
        chaos.step(sleepers)
        kill = chaos.kills[-1]
        assert sleepers[kill.stream].children[kill.process].wait(30) == -signal.SIGKILL
    assert sum(len(stream.pids) for stream in sleepers) == 3


def test_chaos_does_not_kill_one_process_so_often_that_the_supervisor_gives_up(sleepers):
    (stream, _), chaos = sleepers, Chaos(seed=1)
    for _ in range(40):
        before, chaos._due = len(chaos.kills), 0.0
        chaos.step([stream])
        for kill in chaos.kills[before:]:
            stream.children[kill.process].wait(30)
            stream.children[kill.process] = stream.start()
    names = [kill.process for kill in chaos.kills]
    assert {name: names.count(name) for name in names} == {"detector": 4, "compressor": 4, "trainer": 4}


def test_no_child_receives_ctrl_c():
    script = """if True:
        import time
        from catstream.services.start import SPAWN, sigint_blocked
        child = SPAWN.Process(target=time.sleep, args=(600,))
        with sigint_blocked():
            child.start()
        print(open(f"/proc/{child.pid}/status").read())
        child.kill()
    """
    status = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    blocked = int(re.search(r"SigBlk:\s*(\w+)", status.stdout)[1], 16)
    assert blocked & 1 << (signal.SIGINT - 1)


def test_usage_shows_which_process_is_busy(sleepers):
    usage, busy = Usage(), psutil.Process().pid
    usage.read(0.0, {"busy": [busy], "idle": [sleepers[0].pids["trainer"]]})
    deadline = time.process_time() + 0.3
    while time.process_time() < deadline:
        pass
    usage.read(1.0, {"busy": [busy], "idle": [sleepers[0].pids["trainer"]]})
    assert usage.readings["idle"][0].cores < usage.readings["busy"][0].cores
    assert usage.readings[REST][0].cores >= 0
    assert 0 < usage.readings["idle"][0].memory < usage.readings["busy"][0].memory


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


@pytest.mark.slow
def test_all_killed_processes_recover():
    load_test = run_load_test(Plan(streams=2, rate=8.0, duration=40.0, size=(320, 240), chaos=True), [], find=False)
    assert not load_test.violations
    assert len(load_test.result.recoveries) >= 5
    early = [
        recovery
        for recovery in load_test.result.recoveries
        if recovery.kill.moment < load_test.result.streams[0].due[200]
    ]
    assert all(recovery.track is not None and recovery.model is not None for recovery in early)
    assert all(stream.not_stored == 0 for stream in load_test.result.streams)
    assert children() == []


@pytest.mark.slow
def test_a_search_ends_with_a_rate_that_meets_the_limits_below_one_that_does_not():
    plan = Plan(rate=30.0, duration=3.0, size=(320, 240))
    load_test = run_load_test(plan, [Limit("p99", 1.0), Limit("skipped", 0.05)], find=True)
    held = {step.plan.rate for step in load_test.results if not violations(load_test.limits, step)}
    assert load_test.highest_rate in held
    assert load_test.result.plan.rate == max(held)
    assert any(violations(load_test.limits, step) for step in load_test.results) or load_test.highest_rate == 1000.0
