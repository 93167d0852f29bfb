"""Workers: they are started once, survive a Ctrl-C of their own, and end with their owner."""

import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest

from catstream.base.workers import Workers, run_tasks, sigint_blocked


def test_ctrl_c_interrupts_after_all_workers_were_started():
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


def test_workers_ignore_ctrl_c():
    """A worker that ended on its own would be reported as killed, also by a caller that ignores Ctrl-C."""
    assert list(run_tasks(signal.raise_signal, [(signal.SIGINT,)] * 2, jobs=2)) == [None, None]


def test_caller_that_stops_early_leaves_no_worker():
    results = run_tasks(abs, [(-1,), (-2,), (-3,)], jobs=2)
    assert next(results) in {1, 2, 3}
    running = multiprocessing.active_children()
    results.close()
    assert len(running) == 2
    assert not multiprocessing.active_children()


def test_workers_are_started_again_after_a_caller_stopped_early():
    with closing(Workers(1)) as workers:
        with closing(workers.run(os.getpid, [(), ()])) as stopped:
            first = next(stopped)
        assert [*workers.run(os.getpid, [()])] != [first]


def test_workers_outlive_the_thread_that_started_them():
    with closing(Workers(1)) as workers:
        with ThreadPoolExecutor(1) as thread:
            first = thread.submit(lambda: [*workers.run(os.getpid, [()])]).result()
        assert [*workers.run(os.getpid, [()])] == first != [os.getpid()]
    assert not multiprocessing.active_children()


def test_workers_end_with_a_process_that_is_killed(alive, until):
    code = (
        "import os; from catstream.base.workers import Workers\n"
        "if __name__ == '__main__':\n"
        "    print(*Workers(1).run(os.getpid, [()]), flush=True); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    worker = int(killed.stdout)
    until(lambda: not alive(worker))
