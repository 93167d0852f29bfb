"""The watchdog of a process: a count of the turns of its loop, in memory that its parent can read.

Parent and child share a few bytes of memory. No messages are involved, which could be late or lost: a parent that was
suspended reads the newest count at once, and the count stops with the loop, even if other threads continue.
"""

from __future__ import annotations

import mmap
import os
import time

from catstream.services.timing import LONGEST_STUCK_SECONDS, START_SECONDS, STUCK_SECONDS

_SIZE = 16  # two float64: turns, and patience
_TURNS_LONG = 5.0  # patience as a multiple of the slowest recent turn
_FADES = 0.99  # factor by which the slowest recent turn is forgotten with each turn


class Watchdog:
    """The loop calls `beat`, `allow` and `allow_each`; its parent reads `turns` and `patience`.

    Parameters
    ----------
    handle : inherited file descriptor of the memory; None to make a new one
    least : seconds that any turn may take
    """

    def __init__(self, handle: int | None = None, least: float = STUCK_SECONDS) -> None:
        made = handle is None
        self.handle = os.memfd_create("watchdog") if handle is None else handle
        if made:
            os.truncate(self.handle, _SIZE)
        self._cells = memoryview(mmap.mmap(self.handle, _SIZE)).cast("d")
        self._least, self._slowest, self._last = least, 0.0, time.monotonic()
        self._allowed = True  # the first turn is the start
        if made:
            self._cells[1] = START_SECONDS

    @property
    def turns(self) -> float:
        """Number of turns so far."""
        return self._cells[0]

    @property
    def patience(self) -> float:
        """Seconds that the present turn may take."""
        return self._cells[1]

    def beat(self) -> None:
        """Count a turn. If turns are slow on this machine, the next ones may be slower."""
        now = time.monotonic()
        if not self._allowed:
            self._slowest = max(now - self._last, _FADES * self._slowest)
        self._last, self._allowed = now, False
        self._cells[1] = max(self._least, min(_TURNS_LONG * self._slowest, LONGEST_STUCK_SECONDS))
        self._cells[0] += 1

    def allow(self, seconds: float) -> None:
        """Set the time that the present turn may take."""
        self._allowed = True
        self._cells[1] = max(self._least, seconds)
        self._cells[0] += 1

    def allow_each(self, seconds: float) -> None:
        """Add to the time that each later turn may take."""
        self._least += seconds

    def close(self) -> None:
        """Close the file descriptor; the memory stays as long as the object."""
        os.close(self.handle)
