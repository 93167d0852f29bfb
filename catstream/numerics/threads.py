"""Limits linear algebra to one thread while catstream computes.

The matrices are small. With more threads, OpenBLAS spends its time on synchronisation (a tenth of the frame rate), and
the order of its sums changes, so results are not reproducible. The processes of a pipeline set environment variables
before numpy is imported (`limit_process`). Inside a user's process, `one_thread` limits the number of threads during
each call and restores it afterwards.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def limit_process() -> None:
    """Limit all libraries of this process to one thread, unless the user's environment sets another number.

    Call it before numpy is imported: the libraries read the environment when they are loaded.
    """
    for variable in _VARIABLES:
        os.environ.setdefault(variable, "1")


class _Library(Protocol):
    """The part of the interface of a threadpoolctl controller that is used here."""

    user_api: str
    filepath: str

    def get_num_threads(self) -> int | None: ...
    def set_num_threads(self, num_threads: int) -> object: ...


class _Libraries:
    """The threaded libraries that are loaded in this process, and a count of the users that limit them to one thread.

    A BLAS has one number of threads for the whole process: the first user sets it, and the last one restores it. OpenMP
    has one for each calling thread: each user sets and restores its own.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._modules = 0  # number of imported modules at the last search for libraries
        self._blas: list[_Library] = []
        self._openmp: list[_Library] = []
        self._users = 0
        self._original: dict[str, tuple[_Library, int]] = {}  # path -> a BLAS, and its threads before the first holder

    def limit(self) -> list[tuple[_Library, int]]:
        """Set one thread; return the argument for `restore`."""
        with self._lock:
            self._find()
            self._users += 1
            for library in self._blas:
                if library.filepath not in self._original:
                    self._original[library.filepath] = (library, library.get_num_threads() or 1)
                    _set(library, 1)
            own = [(library, library.get_num_threads() or 1) for library in self._openmp]
            for library, _ in own:
                _set(library, 1)
            return own

    def restore(self, own: list[tuple[_Library, int]]) -> None:
        """Undo one `limit`."""
        with self._lock:
            for library, threads in own:
                _set(library, threads)
            self._users -= 1
            if self._users:
                return
            for library, threads in self._original.values():
                if library.get_num_threads() == 1:  # otherwise the user's program has changed it: keep that
                    _set(library, threads)
            self._original.clear()

    def _find(self) -> None:
        """Search for libraries if a module was imported since the last search; takes a few milliseconds.

        Those that catstream computes with are loaded first: one that is loaded after the search would have all threads.
        """
        if len(sys.modules) == self._modules:
            return
        import scipy.linalg  # noqa: F401  brings a BLAS beside that of numpy
        from threadpoolctl import ThreadpoolController

        self._modules = len(sys.modules)
        libraries = ThreadpoolController().lib_controllers
        self._openmp = [library for library in libraries if _is_openmp(library)]
        self._blas = [library for library in libraries if not _is_openmp(library)]


def _is_openmp(library: _Library) -> bool:
    return library.user_api == "openmp" or getattr(library, "threading_layer", "") == "openmp"


def _set(library: _Library, threads: int) -> None:
    # threadpoolctl lets only one thread of a process set OpenBLAS; here any thread may be the last user.
    getattr(library, "_real_set_num_threads", library.set_num_threads)(threads)


_libraries = _Libraries()


@contextmanager
def one_thread(*, opencv: bool = False) -> Iterator[None]:
    """Run linear algebra on one thread inside a `with`, or inside the function that it decorates.

    It may be nested and used by several threads at once: the last one to leave restores the number of threads, also
    after an exception. Meanwhile, linear algebra in other threads of the process runs on one thread, too. It costs a
    few microseconds.

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
    own = _libraries.limit()
    try:
        yield
    finally:
        _libraries.restore(own)
        if opencv:
            cv2.setNumThreads(threads)
