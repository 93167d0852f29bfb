"""Worker processes, for evaluation, annotation and load tests.

They exit with their parent. SIGINT is blocked in them, because on Ctrl-C the parent stops them in order: a worker that
exited first would be reported as killed.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from typing import TypeVar

from catstream.errors import ServiceError

_Result = TypeVar("_Result")

#: The start method of all workers.
SPAWN = multiprocessing.get_context("spawn")


@contextmanager
def sigint_blocked() -> Iterator[None]:
    """Start processes with SIGINT blocked inside a `with`; a Ctrl-C is handled after the block.

    Blocking alone is not enough: another thread receives the signal, and Python handles it in the main thread. A
    process whose start is interrupted would wait for its arguments forever.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # its start would unblock the signal
    received: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()  # the thread in which Python handles signals
    handler = signal.signal(signal.SIGINT, lambda number, _: received.append(number)) if is_main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a child inherits it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if is_main:
            signal.signal(signal.SIGINT, handler)
            if received:
                signal.raise_signal(signal.SIGINT)


@contextmanager
def sharing() -> Iterator[None]:
    """Convert an OSError while shared memory or locks are created to a ServiceError."""
    try:
        yield
    except OSError as error:
        raise ServiceError(
            f"processes cannot share memory ({error.strerror}): let /dev/shm be writable; catstream track and "
            "catstream evaluate --jobs 1 do without"
        ) from None


class Workers:
    """A pool of processes. The first tasks start them, and `close` stops them."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None
        self._processes: set[BaseProcess] = set()

    def submit(self, work: Callable[..., _Result], *task: object) -> Future[_Result]:
        """Run `work(*task)` as soon as a process is free; `result` returns its result."""
        with sigint_blocked():  # the workers are started here
            others = set(multiprocessing.active_children())
            future = self._started().submit(work, *task)
            self._processes |= set(multiprocessing.active_children()) - others
        return future

    def result(self, future: Future[_Result]) -> _Result:
        """The result of a task; ServiceError if its process was killed."""
        try:
            return future.result()
        except BrokenProcessPool:
            raise ServiceError(
                "a worker process has died: if memory was short, use fewer jobs; a Python program needs "
                '`if __name__ == "__main__":` around its calls'
            ) from None

    def run(self, work: Callable[..., _Result], tasks: Iterable[tuple[object, ...]]) -> Generator[_Result]:
        """Yield the result of `work(*task)` for each task, in order of completion.

        If the caller stops early, for example on Ctrl-C, all workers are killed; later tasks start new workers.
        """
        try:
            for future in as_completed([self.submit(work, *task) for task in tasks]):
                yield self.result(future)
        except BaseException:
            self.kill()
            raise

    def kill(self) -> None:
        """Kill the workers, and drop their tasks; later tasks start new workers."""
        for worker in self._processes:
            worker.kill()
        self.close()

    def close(self) -> None:
        """Stop the workers after their tasks."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool, self._processes = None, set()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            with sharing():
                self._pool = ProcessPoolExecutor(self._jobs, mp_context=SPAWN, initializer=_end_with_parent)
        return self._pool


def run_tasks(work: Callable[..., _Result], tasks: Iterable[tuple[object, ...]], jobs: int) -> Generator[_Result]:
    """Yield the results of tasks as `Workers.run` does, from processes that end with the last task."""
    with closing(Workers(jobs)) as workers:
        yield from workers.run(work, tasks)


def _end_with_parent() -> None:
    """Exit when the parent process exits; `die_with` would react to the exit of the thread that started this worker."""

    def wait() -> None:
        if (parent := multiprocessing.parent_process()) is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
