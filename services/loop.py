"""What every process of the pipeline does alike: signals, health, errors, and not to outlive its parent."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import time
from collections.abc import Callable
from typing import NamedTuple

from catstream.errors import CatstreamError, SetBackError
from catstream.messages import Health, Run
from catstream.services.watchdog import PATIENCE, Watchdog
from catstream.settings import Settings
from catstream.wire.endpoint import Endpoint
from catstream.wire.refusals import refusals
from catstream.wire.sockets import Publisher

__all__ = ["BROKEN", "REFUSED", "Parent", "Process", "die_with", "run"]

#: Exit code of a process that would fail the same way again: it is not restarted.
REFUSED = 2

#: Exit code of a process that has done its work, on a stream that ended before it should: it is not restarted either.
BROKEN = 3

_CLOSE_SECONDS = 30.0
_QUICK_SIZE = 128  # coreset size up to which a turn of compressor and trainer is short on any machine
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
_log = logging.getLogger(__name__)


class Parent(NamedTuple):
    """Who started a process, and is not to be outlived.

    pid    its process id
    watchdog  file descriptor of the memory in which it watches the watchdog; None where it does not
    """

    pid: int
    watchdog: int | None


class Process:
    """What a process has, whichever it is.

    settings, endpoint : as all processes of this pipeline have them
    trouble, source : what is wrong, for a person, and the source that is followed; told with its health
    broken : whether the stream ended before it should, as its `End` tells
    """

    def __init__(self, name: str, settings: Settings, watchdog: int | None = None) -> None:
        self.name = name
        self.settings = settings
        self.endpoint = Endpoint.parse(settings.run.endpoint, settings.run.keys)
        self.trouble = self.source = ""
        self.broken = False
        # All but the detector turn in a time that grows with the coreset size.
        factor = 1.0 if name == "detector" else max(1.0, (settings.coreset.size / _QUICK_SIZE) ** 2)
        self._watchdog = Watchdog(watchdog, PATIENCE * factor)
        self._asked = float("inf")  # when it was asked to end
        self._health = Publisher("health", self.endpoint, sender=name)
        self._beat = 0.0
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)

    @property
    def ended(self) -> bool:
        """Whether it was asked to end."""
        return self.ended_for(0)

    @property
    def run(self) -> Run:
        """What this pipeline runs with, for those who want to learn from its features once more."""
        return Run.of(self.settings.portable())

    def ended_for(self, seconds: float) -> bool:
        """Whether it was asked to end, at least so long ago."""
        return time.monotonic() - self._asked >= seconds

    def beat(self, counters: Callable[[], dict[str, float]], now: bool = False) -> None:
        """Tell how it is, once a second; cheap, and to be called in every turn of a loop."""
        self._watchdog.beat()
        if now:  # it may be the last turn, after which sockets take their time to close
            self._watchdog.allow(_CLOSE_SECONDS)
        if now or time.monotonic() - self._beat >= 1:
            self._beat = time.monotonic()
            self._health.send(Health(self.name, time.time(), counters() | refusals(), self.trouble, self.source))
        else:
            self._health.welcome()

    def allow(self, seconds: float) -> None:
        """Say that this turn of the loop may take so long: it is not stuck before."""
        self._watchdog.allow(seconds)

    def allow_each(self, seconds: float) -> None:
        """Say that each turn of the loop from now on may take so much longer."""
        self._watchdog.allow_each(seconds)

    def close(self) -> None:
        """Send the last health, then close."""
        self._health.close()

    def _end(self, *_: object) -> None:
        self._asked = min(self._asked, time.monotonic())


def run(name: str, main: Callable[[Process], None], settings: Settings, parent: Parent | None) -> int:
    """Be a process of the pipeline until it ends.

    Parameters
    ----------
    parent : the one that started this; None to be independent

    Returns
    -------
    its exit code: 0 at the end of the stream or after SIGTERM, `BROKEN` where the source broke, `REFUSED` for an error
    that names its cause, and that would come again
    """
    if parent is not None:
        die_with(parent.pid)
    try:
        process = Process(name, settings, parent.watchdog if parent else None)
        try:
            main(process)
        finally:
            process.close()
    except SetBackError as error:
        _log.warning("%s", error)
        return 1
    except CatstreamError as error:
        _log.error("%s", error)
        return REFUSED
    return BROKEN if process.broken else 0


def die_with(parent: int) -> None:
    """Have the kernel kill this process when the one that started it is gone: no orphan is left."""
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it went before the kernel was told
        raise SystemExit(0)
