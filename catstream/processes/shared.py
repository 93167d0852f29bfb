"""Memory that a process shares with its supervisor: the descriptor `handle` is inherited.

No value in it can be late or lost: a supervisor that was suspended reads the newest ones at once.
"""

from __future__ import annotations

import ctypes
import mmap
import os

RUNNING_SECONDS = 10.0  #: without a turn of its loop, after which a process counts as stuck
LONG_SECONDS = 120.0  #: the same for a start, and for a step that takes long and was announced


class Watchdog(ctypes.Structure):
    """Counts the turns of the loop of a process. The count stops with the loop, even if other threads continue.

    turns     number of turns of the loop so far
    patience  seconds that the present turn may take
    limit     seconds that a turn may take that was not announced
    """

    _fields_ = (("turns", ctypes.c_double), ("patience", ctypes.c_double))
    turns: float
    patience: float
    limit = RUNNING_SECONDS

    def beat(self) -> None:
        """Count a turn of the loop."""
        self.allow(self.limit)

    def allow(self, seconds: float = LONG_SECONDS) -> None:
        """Announce that the present turn takes long."""
        self.patience = seconds
        self.turns += 1


class Owner(ctypes.Structure):
    """The owner of the run: the frames that it has, as a detector is not too far ahead of it, and has not written.

    after        number of the last message that it had when the process was started
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
