"""Calls to the kernel and the C library about this process: its parent, its name and its memory."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
_SET_NAME = 15  # PR_SET_NAME
_ARGUMENTS = slice(45, 47)  # of the fields after the name in /proc/self/stat: arg_start and arg_end


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent exits, so that no orphan remains."""
    if sys.platform != "linux":  # elsewhere, an orphan exits when it reads its next task
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent ended before the call of prctl
        raise SystemExit(0)


def name_process(name: str, command: str = "") -> None:
    """Show a name in `top`, cut after 15 characters, and a command line in `ps`, cut to the length of the present one.

    Every user of the machine can read them. Without a `command`, the present one stays. No effect except on Linux.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_SET_NAME, name.encode(errors="replace"), 0, 0, 0)
    if not command:
        return
    with suppress(OSError):  # /proc is not mounted
        first, end = map(int, Path("/proc/self/stat").read_text().rpartition(")")[2].split()[_ARGUMENTS])
        text = command.encode(errors="replace")[: max(0, end - first - 1)]
        ctypes.memmove(first, text.ljust(end - first, b"\0"), end - first)


def release_memory() -> None:
    """Return freed memory, which glibc caches, to the kernel; no effect with other C libraries."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
