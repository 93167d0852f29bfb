"""Ctrl-C ends an evaluation in one line, with all its processes."""

import multiprocessing
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest

from catstream.applications.workers import run_tasks, sigint_blocked
from catstream.cli.common import INTERRUPTED


def test_ctrl_c_while_the_workers_start_is_one_line_and_no_worker_is_left(walk, catstream, tmp_path):
    """The terminal sends it to all of them, of which the workers are at their imports."""
    runs = ["--starts", 4, "--jobs", 2, "--output", tmp_path / "out"]
    process = catstream("evaluate", walk, *runs, process_group=0)
    family = psutil.Process(process.pid)
    while len(family.children()) < 3 and process.poll() is None:  # two workers, and the tracker of their resources
        pass
    children = family.children()
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate()
    assert "Traceback" not in errors
    assert errors.splitlines()[-1].startswith("stopped: complete runs are in ")
    assert process.returncode == INTERRUPTED
    assert not psutil.wait_procs(children, timeout=10)[1]


def test_ctrl_c_that_another_thread_receives_interrupts_only_after_all_workers_were_started():
    started = []

    def start_all(other):
        with sigint_blocked():
            for worker in range(2):
                other.submit(signal.raise_signal, signal.SIGINT).result()
                started.append(worker)

    with ThreadPoolExecutor(1) as other:
        other.submit(abs, 0).result()  # the thread exists, and does not block the signal
        with pytest.raises(KeyboardInterrupt):
            start_all(other)
    assert started == [0, 1]


def test_ctrl_c_ends_no_worker_because_the_caller_does():
    """A worker that ended on its own would be reported as killed, also by a caller that ignores Ctrl-C."""
    assert list(run_tasks(signal.raise_signal, [(signal.SIGINT,)] * 2, jobs=2)) == [None, None]


def test_a_caller_that_stops_early_leaves_no_worker():
    given = run_tasks(abs, [(-1,), (-2,), (-3,)], jobs=2)
    assert next(given) in {1, 2, 3}
    running = multiprocessing.active_children()
    given.close()
    assert len(running) == 2
    assert not multiprocessing.active_children()
