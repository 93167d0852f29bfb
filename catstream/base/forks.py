"""Fork safety: a forked process must neither use nor clean up the objects that it inherited.

A fork copies memory and descriptors, but no threads. A child that closed a socket, removed a file or stopped a process
of its parent would break the parent. Such an object stores the `generation` of its creation. It checks `forked` before
a cleanup, and `check_not_forked` before its use. `after_fork` resets the state of a module.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from catstream.errors import ServiceError

_generation = 0


def generation() -> int:
    """Number of forks between the first process of the program and this one."""
    return _generation


def forked(since: int) -> bool:
    """Return True if this process was forked since `generation` returned `since`."""
    return _generation != since


def check_not_forked(since: int) -> None:
    """Raise ServiceError if this process was forked since `generation` returned `since`."""
    if forked(since):
        raise ServiceError(
            "unusable after a fork (this process is a copy of the one that created it): create it in the process that "
            "uses it"
        )


def after_fork(function: Callable[[], object]) -> None:
    """Call a function first in each process that is forked from this one."""
    if hasattr(os, "register_at_fork"):  # Windows has no fork
        os.register_at_fork(after_in_child=function)


def _count() -> None:
    global _generation
    _generation += 1


after_fork(_count)
