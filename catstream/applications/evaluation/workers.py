"""Runs tasks in worker processes, which end with their parent.

SIGINT stays blocked in the workers: on Ctrl-C, the parent kills them. Otherwise they would end before the parent, which
would report a worker that was killed, and they would end in a job whose parent ignores SIGINT, as in the background.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from catstream.errors import ServiceError
from catstream.services.loop import die_with
from catstream.services.start import SPAWN

__all__ = ["run_tasks"]

_Result = TypeVar("_Result")

_CTRL_C = {signal.SIGINT}


def run_tasks(work: Callable[..., _Result], tasks: Sequence[tuple[object, ...]], jobs: int) -> Generator[_Result]:
    """Yield the result of `work(*task)` for each task, in order of completion, from `jobs` processes.

    If the caller stops early, for example on Ctrl-C, all workers are killed.

    Raises
    ------
    ServiceError
        If a worker was killed by another process or the kernel.
    """
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(jobs, mp_context=SPAWN, initializer=die_with, initargs=(os.getpid(),)) as pool:
        try:
            for future in as_completed(_submit(pool, work, tasks)):
                yield future.result()
        except BrokenProcessPool:
            raise ServiceError("a process of the evaluation was killed (out of memory?): try fewer --jobs") from None
        except BaseException:
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
            raise


def _submit(
    pool: ProcessPoolExecutor, work: Callable[..., _Result], tasks: Sequence[tuple[object, ...]]
) -> list[Future[_Result]]:
    """Submit all tasks. The workers are started here, and inherit the blocked SIGINT."""
    with _deferred_ctrl_c():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _CTRL_C)
        try:
            return [pool.submit(work, *task) for task in tasks]
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _deferred_ctrl_c() -> Iterator[None]:
    """Handle a Ctrl-C that arrives inside a `with` after it.

    A mask alone does not hold it back: the signal arrives in another thread, and Python handles it in the main one. A
    worker whose start is interrupted would not get the data that it waits for.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread only
        return
    received: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if received:
            signal.raise_signal(signal.SIGINT)
