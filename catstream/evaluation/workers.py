"""Runs tasks in worker processes that end on Ctrl-C without a traceback.

This module is the first one that a worker imports, before those that take long to import.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from catstream.errors import ServiceError
from catstream.services.loop import die_with
from catstream.services.start import SPAWN

__all__ = ["run_tasks"]

_Result = TypeVar("_Result")

_CTRL_C = {signal.SIGINT}


def run_tasks(work: Callable[..., _Result], tasks: Sequence[tuple[object, ...]], jobs: int) -> Iterator[_Result]:
    """Yield the result of `work(*task)` for each task, in order of completion, from `jobs` processes.

    If the caller stops early, for example on Ctrl-C, all workers are killed.

    Raises
    ------
    ServiceError
        If a worker was killed by another process or the kernel.
    """
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(jobs, mp_context=SPAWN, initializer=_init_worker, initargs=(os.getpid(),)) as pool:
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
    """Submit all tasks. The workers are started here, and inherit a blocked SIGINT; `_init_worker` unblocks it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _CTRL_C)
    try:
        return [pool.submit(work, *task) for task in tasks]
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _init_worker(parent: int) -> None:
    """Let Ctrl-C end this worker without output, and end it with its parent."""
    die_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _CTRL_C)
