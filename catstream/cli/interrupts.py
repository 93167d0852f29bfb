"""Ctrl-C, SIGTERM and a terminal that is lost: they take effect between two frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Interrupts"]


class Interrupts:
    """Raises KeyboardInterrupt for each of these signals, at the end of a `held` block if one came within it."""

    def __init__(self) -> None:
        self._held = self._came = False

    def install(self) -> None:
        """Take over the signals; of those that a shell or nohup has this process ignore, only SIGTERM."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._take)

    @contextmanager
    def held(self) -> Iterator[None]:
        """A block that none of them interrupts."""
        self._held = True
        try:
            yield
        finally:
            self._held = False
        if self._came:
            self._came = False
            raise KeyboardInterrupt

    def _take(self, *_: object) -> None:
        if not self._held:
            raise KeyboardInterrupt
        self._came = True
