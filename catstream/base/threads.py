"""Limits linear algebra to one thread while catstream computes.

The matrices are small. With more threads, OpenBLAS spends its time on synchronisation (a tenth of the frame rate), and
the order of its sums changes, so results are not reproducible. The processes of a pipeline set environment variables
before numpy is imported (`limit_process`). Inside a user's process, `one_thread` limits the number of threads during
each call and restores it afterwards.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


#: Environment variables that limit the libraries of a new process to one thread.
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

#: Lock for changes of the warning filters, which all threads of a program share.
FILTERS = threading.Lock()


def limit_process() -> None:
    """Limit all libraries of this process to one thread, unless the user's environment sets another number.

    Call it before numpy is imported: the libraries read the environment when they are loaded.
    """
    os.environ.update(ONE_THREAD | os.environ)


class _Limit:
    """Limits each BLAS to one thread while any call needs it: the number of threads is per process."""

    def __init__(self) -> None:
        self._lock, self._calls = threading.Lock(), 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._calls:
                self._set = self._controller().limit(limits=1)
            self._calls += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._calls -= 1
            if not self._calls:
                self._controller()
                self._set.restore_original_limits()

    @staticmethod
    def _controller() -> ThreadpoolController:
        """The BLAS libraries of this process, with the right of this thread to limit them."""
        controller = _libraries("blas")
        for library in controller.lib_controllers:
            if library.internal_api == "openblas":  # otherwise, only the first thread that set a limit may change it
                library.clear_controlling_thread(force=True)
        return controller


_limit = _Limit()


def _libraries(kind: str) -> ThreadpoolController:
    """The libraries of a kind that are loaded in this process: "blas" or "openmp"."""
    import scipy.linalg  # noqa: F401  loads a second BLAS, which would not be limited if it was loaded later
    from threadpoolctl import get_cached_controller

    return get_cached_controller().select(user_api=kind)


@contextmanager
def one_thread(*, opencv: bool = False) -> Iterator[None]:
    """Run linear algebra on one thread inside a `with`, or inside the function that it decorates.

    It may be nested and used by several threads at once: the last one to leave restores the number of threads.
    Meanwhile, linear algebra in other threads of the process also runs on one thread. It costs about 30 microseconds.

    Parameters
    ----------
    opencv : also limit OpenCV to one thread; this must not be used by several threads at once

    >>> from threadpoolctl import threadpool_info
    >>> import numpy
    >>> with one_thread():
    ...     {library["num_threads"] for library in threadpool_info()}
    {1}
    """
    if opencv:
        import cv2

        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
    try:
        with _limit, _libraries("openmp").limit(limits=1):  # the limit of OpenMP is per calling thread
            yield
    finally:
        if opencv:
            cv2.setNumThreads(threads)


@cache
def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
