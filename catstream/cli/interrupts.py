"""Defers SIGINT, SIGTERM and SIGHUP to the end of a block, so that they take effect between two frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Interrupts"]


class Interrupts:
    """Raises KeyboardInterrupt for each of these signals; inside a `deferred` block, at the end of the block."""

    def __init__(self) -> None:
        self._deferring = self._pending = False

    def install(self) -> None:
        """Install the handlers. A signal that is ignored, as under nohup, stays ignored, except SIGTERM."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._handle)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """A block that these signals do not interrupt."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt

    def _handle(self, *_: object) -> None:
        if not self._deferring:
            raise KeyboardInterrupt
        self._pending = True
