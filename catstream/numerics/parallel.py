"""Calls a function for several items at once, in threads, if this process may use several cores.

The compiled kernels, OpenCV and linear algebra release the GIL, so threads compute at the same time. The order of the
results is that of the items, and each call is independent: the results do not depend on the number of threads.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from typing import TypeVar

import numpy as np

from catstream.numerics.threads import one_thread

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Held by a call that changes the filters of warnings: all threads of a program have the same ones.
FILTERS = threading.Lock()


class Scratch(threading.local):
    """The arrays for intermediate results of a kernel, which a function makes for some sizes.

    Each thread keeps those of the last sizes: to make them for a small image takes a third as long as the kernel.

    Attributes
    ----------
    made : the function
    kept : the same, but arrays that this thread made before are used again
    """

    def __init__(self, made: Callable[..., tuple[np.ndarray, ...]]) -> None:
        self.made, self.kept = made, lru_cache(maxsize=16)(made)


def in_parallel(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Return `function(item)` for each item; linear algebra in each call runs on one thread.

    If a call raises an exception, the first of these is raised, in the order of the items.

    >>> in_parallel(abs, [-3, 2, -1])
    [3, 2, 1]
    """
    waiting = list(items)
    if len(waiting) < 2 or _cores() < 2:
        return [function(item) for item in waiting]

    def limited(item: _Item) -> _Result:
        with one_thread():
            return function(item)

    calls = [_pool().submit(limited, item) for item in waiting]
    for call in calls:
        call.exception()  # waits
    return [call.result() for call in calls]


@cache
def _cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    """The threads of this process."""
    return ThreadPoolExecutor(_cores(), "catstream")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
