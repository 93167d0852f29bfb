"""Copies of this process that a program forks: an object that such a copy inherited is not its own.

A fork copies memory and descriptors, but no thread: a copy that closed a socket, removed a file or stopped a process of
the original would break it. Whoever makes such an object remembers the `generation`, and asks `forked` before it cleans
up, or calls `check_not_forked` before it uses the object. State of a module is replaced by `after_fork`.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from catstream.errors import ServiceError

_generation = 0


def generation() -> int:
    """The number of forks between the first process of the program and this one."""
    return _generation


def forked(since: int) -> bool:
    """Return True if this process is a copy of the one in which `generation` returned `since`."""
    return _generation != since


def check_not_forked(since: int) -> None:
    """Raise ServiceError if this process is a copy of the one in which `generation` returned `since`."""
    if forked(since):
        raise ServiceError(
            "unusable after a fork (this process is a copy of the one that created it): create it in the process that "
            "uses it"
        )


def after_fork(function: Callable[[], object]) -> None:
    """Call a function in each process that is forked from this one, before anything else."""
    if hasattr(os, "register_at_fork"):  # Windows has no fork
        os.register_at_fork(after_in_child=function)


def _count() -> None:
    global _generation
    _generation += 1


after_fork(_count)
