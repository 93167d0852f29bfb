"""Memory that a process shares with its supervisor, by an inherited file descriptor.

Unlike messages, its values cannot be late or lost: a supervisor that was suspended reads the newest ones at once.
"""

from __future__ import annotations

import ctypes
import mmap
import os

RUNNING_SECONDS = 10.0  #: watchdog limit for an iteration of a process's loop
LONG_SECONDS = 120.0  #: watchdog limit for the start, and for an announced long step


class Watchdog(ctypes.Structure):
    """Counts the iterations of the loop of a process. The count stops with the loop, even if other threads continue.

    iterations  number of iterations so far
    patience    limit in seconds for the current iteration
    limit       default limit in seconds for an iteration
    """

    _fields_ = (("iterations", ctypes.c_double), ("patience", ctypes.c_double))
    iterations: float
    patience: float
    limit = RUNNING_SECONDS

    def beat(self) -> None:
        """Count an iteration."""
        self.allow(self.limit)

    def allow(self, seconds: float = LONG_SECONDS) -> None:
        """Announce that the current iteration may take up to `seconds`."""
        self.patience = seconds
        self.iterations += 1


class Consumer(ctypes.Structure):
    """Progress of the consumer of the results: the detector waits for its reads, and reports its write errors.

    after        number of the last message received before the process was started
    read         number of the last message read, infinite after the end
    not_written  number of frames that could not be written to the results
    trouble      current write error, UTF-8; empty if there is none
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
    """The two records, in the memory of a file descriptor or in new memory."""

    def __init__(self, handle: int | None = None) -> None:
        self.handle = os.memfd_create("catstream") if handle is None else handle
        size = ctypes.sizeof(Watchdog) + ctypes.sizeof(Consumer)
        os.truncate(self.handle, size)
        memory = mmap.mmap(self.handle, size)
        self.watchdog = Watchdog.from_buffer(memory)
        self.consumer = Consumer.from_buffer(memory, ctypes.sizeof(Watchdog))
        self.watchdog.allow()

    def close(self) -> None:
        """Close the file descriptor; the memory stays as long as the records."""
        os.close(self.handle)
