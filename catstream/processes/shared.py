"""Memory that a process shares with its supervisor: the descriptor `handle` is inherited.

No value in it can be late or lost: a supervisor that was suspended reads the newest ones at once.
"""

from __future__ import annotations

import ctypes
import mmap
import os

RUNNING_SECONDS = 10.0  #: without an iteration of its loop, after which a process counts as stuck
LONG_SECONDS = 120.0  #: the same for a start, and for a step that takes long and was announced


class Watchdog(ctypes.Structure):
    """Counts the iterations of the loop of a process, which stop with the loop even if other threads continue.

    turns     number of iterations so far
    patience  seconds that the current iteration may take
    limit     seconds that an iteration may take without announcement
    """

    _fields_ = (("turns", ctypes.c_double), ("patience", ctypes.c_double))
    turns: float
    patience: float
    limit = RUNNING_SECONDS

    def beat(self) -> None:
        """Count an iteration."""
        self.allow(self.limit)

    def allow(self, seconds: float = LONG_SECONDS) -> None:
        """Announce that the current iteration takes long."""
        self.patience = seconds
        self.turns += 1


class Owner(ctypes.Structure):
    """The progress of the program that owns the run: the detector waits for its reads, and reports its write errors.

    after        number of the last message that it had received when the process was started
    read         number of the last message that it has read, infinite once it has received the end
    not_written  frames that it could not write to its results
    trouble      why it cannot write them, UTF-8; empty if it can
    """

    _fields_ = (
        *(("after", ctypes.c_int64), ("read", ctypes.c_double)),
        *(("not_written", ctypes.c_int64), ("trouble", ctypes.c_char * 1000)),
    )
    after: int
    read: float
    not_written: int
    trouble: bytes


class SharedMemory:
    """The two records, in the memory of a descriptor or in new memory."""

    def __init__(self, handle: int | None = None) -> None:
        self.handle = os.memfd_create("catstream") if handle is None else handle
        size = ctypes.sizeof(Watchdog) + ctypes.sizeof(Owner)
        os.truncate(self.handle, size)
        memory = mmap.mmap(self.handle, size)
        self.watchdog = Watchdog.from_buffer(memory)
        self.owner = Owner.from_buffer(memory, ctypes.sizeof(Watchdog))
        self.watchdog.allow()

    def close(self) -> None:
        """Close the file descriptor; the memory stays as long as the records."""
        os.close(self.handle)
