"""Runs tasks in worker processes, which end with their parent.

SIGINT stays blocked in the workers: on Ctrl-C, the parent kills them. Otherwise they would end before the parent, which
would report a worker that was killed, and they would end in a job whose parent ignores SIGINT, as in the background.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from catstream.errors import ServiceError
from catstream.services.process import SPAWN, die_with, sigint_blocked

_Result = TypeVar("_Result")


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
            with sigint_blocked():  # the workers are started here
                futures = [pool.submit(work, *task) for task in tasks]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            raise ServiceError("a process of the evaluation was killed (out of memory?): try fewer --jobs") from None
        except BaseException:
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
            raise
