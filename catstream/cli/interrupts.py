"""Ctrl-C, SIGTERM and the loss of the terminal end a command, between two frames."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import click

#: Exit code of a command that was interrupted.
INTERRUPTED = 130

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupts:
    """Raises KeyboardInterrupt for each of these signals, except in the blocks below."""

    def __init__(self) -> None:
        self._leaving = self._deferring = self._pending = False

    def install(self) -> None:
        """Install the handlers. A signal that is ignored, as under nohup, stays ignored, except SIGTERM."""
        for number in _SIGNALS:
            if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._handle)

    @contextmanager
    def leaving(self) -> Iterator[None]:
        """A block in which these signals end this process at once. It is for imports before any work.

        Kernels are compiled during these imports, and the compiler hides a KeyboardInterrupt or makes another error of
        it.
        """
        self._leaving = True
        try:
            yield
        finally:
            self._leaving = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """A block that these signals interrupt at its end only."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
            pending, self._pending = self._pending, False
        if pending:
            raise KeyboardInterrupt

    def end(self) -> None:
        """Ignore these signals from now on: the process ends, and they would only interrupt its last cleaning up."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, *_: object) -> None:
        if self._leaving:
            os.write(2, b"stopped\n")
            os._exit(INTERRUPTED)
        if not self._deferring:
            raise KeyboardInterrupt
        self._pending = True


#: The handlers of this process; the command line installs them.
INTERRUPTS = Interrupts()


def stopped(result: str = "") -> NoReturn:
    """End a command that was interrupted; say what is there so far, and how to continue."""
    click.echo(f"stopped: {result}" if result else "stopped", err=True)
    raise SystemExit(INTERRUPTED)
