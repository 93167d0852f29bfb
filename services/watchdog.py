"""The watchdog of a process: turns of its loop, counted where the one that watches over it can see them.

The two share a few bytes of memory. Nothing is sent, so that nothing can be late, full or lost; who was
asleep sees the newest count at once; and the count stands still as soon as the loop does, whatever
threads go on beside it.
"""

from __future__ import annotations

import mmap
import os
import time

__all__ = ["PATIENCE", "Watchdog"]

#: Seconds without a turn after which a loop counts as stuck, where its turns are short.
PATIENCE = 2.5

_SIZE = 16  # two float64: turns, and the patience that holds
_START_SECONDS = 120.0  # imports, kernels that are compiled
_LONGEST_SECONDS = 60.0  # that slow turns alone may ask for
_TURNS_LONG = 5.0  # a turn may take so many times what the slowest of late took
_FADES = 0.99  # with each turn: what the slowest of late was


class Watchdog:
    """Shared by the loop, which calls `beat`, `allow` and `allow_each`, and by who watches: `turns` and `patience`.

    handle : file descriptor of the memory, inherited; None to make it
    least : seconds that any turn may take
    """

    def __init__(self, handle: int | None = None, least: float = PATIENCE) -> None:
        made = handle is None
        self.handle = os.memfd_create("watchdog") if handle is None else handle
        if made:
            os.truncate(self.handle, _SIZE)
        self._cells = memoryview(mmap.mmap(self.handle, _SIZE)).cast("d")
        self._least, self._slowest, self._last = least, 0.0, time.monotonic()
        self._allowed = True  # the first turn is the start
        if made:
            self._cells[1] = _START_SECONDS

    @property
    def turns(self) -> float:
        """How often the loop turned so far."""
        return self._cells[0]

    @property
    def patience(self) -> float:
        """Seconds that the turn which goes on now may take."""
        return self._cells[1]

    def beat(self) -> None:
        """Say that the loop turned. On a machine on which turns are slow, the next may be slower."""
        now = time.monotonic()
        if not self._allowed:
            self._slowest = max(now - self._last, _FADES * self._slowest)
        self._last, self._allowed = now, False
        self._cells[1] = max(self._least, min(_TURNS_LONG * self._slowest, _LONGEST_SECONDS))
        self._cells[0] += 1

    def allow(self, seconds: float) -> None:
        """Say that the turn which goes on now may take so long."""
        self._allowed = True
        self._cells[1] = max(self._least, seconds)
        self._cells[0] += 1

    def allow_each(self, seconds: float) -> None:
        """Say that each turn from now on may take so much longer."""
        self._least += seconds

    def close(self) -> None:
        """Let go of the handle; the memory stays as long as the object."""
        os.close(self.handle)
