"""What every process of the pipeline has: signals, health, a watchdog, exit codes, and an end with its parent."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import time
from collections.abc import Callable
from typing import NamedTuple

from catstream.errors import CatstreamError, StreamRewoundError
from catstream.job import Job
from catstream.messages import Health, Run
from catstream.services.watchdog import PATIENCE, Watchdog
from catstream.wire.channels import HEALTH
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher
from catstream.wire.rejects import rejects

__all__ = ["BROKEN", "REFUSED", "Parent", "Process", "die_with", "run"]

#: Exit code of a process that would fail in the same way again: it is not restarted.
REFUSED = 2

#: Exit code of a process that did its work on a source that broke: it is not restarted either.
BROKEN = 3

_HEALTH_SECONDS = 1.0
_CLOSE_SECONDS = 30.0  # limit for closing all sockets after the last turn
_QUICK_SIZE = 128  # coreset size up to which one turn of compressor and trainer is short on any machine
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
_log = logging.getLogger(__name__)


class Parent(NamedTuple):
    """The process that started this one, and that this one must not outlive.

    pid       its process id
    watchdog  file descriptor of the memory that it watches, None if it watches none
    """

    pid: int
    watchdog: int | None


class Process:
    """The state that every process of the pipeline has.

    Attributes
    ----------
    job : what the run is
    settings, endpoint : of the job
    trouble, source : what is wrong now, for a person, and the source; both are published with the health
    broken : whether the source broke, as the `End` of the stream reports
    """

    def __init__(self, name: str, job: Job, watchdog: int | None = None) -> None:
        self.name, self.job, self.settings = name, job, job.settings
        self.endpoint = Endpoint.parse(job.endpoint or job.settings.run.endpoint, job.settings.run.keys)
        self.trouble = self.source = ""
        self.broken = False
        # One turn of the compressor or the trainer takes a time that grows with the coreset size.
        factor = 1.0 if name == "detector" else max(1.0, (job.settings.coreset.size / _QUICK_SIZE) ** 2)
        self._watchdog = Watchdog(watchdog, PATIENCE * factor)
        self._asked = float("inf")  # when a signal asked the process to end
        self._health = Publisher(HEALTH, self.endpoint, sender=name)
        self._reported = 0.0
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)

    @property
    def ended(self) -> bool:
        """Whether a signal has asked the process to end."""
        return self.asked_seconds >= 0

    @property
    def asked_seconds(self) -> float:
        """Seconds since a signal asked the process to end; negative if none has."""
        return time.monotonic() - self._asked

    @property
    def run(self) -> Run:
        """The settings of the pipeline, which a recording needs to repeat the learning."""
        return Run.from_settings(self.settings.portable())

    def ended_for(self, seconds: float) -> bool:
        """Whether a signal asked the process to end at least so long ago."""
        return self.asked_seconds >= seconds

    def beat(self, counters: Callable[[], dict[str, float]], now: bool = False) -> None:
        """Reset the watchdog, and publish the health once a second or `now`; call it in each turn of a loop."""
        self._watchdog.beat()
        if now:  # this may be the last turn, and sockets take their time to close
            self._watchdog.allow(_CLOSE_SECONDS)
        if now or time.monotonic() - self._reported >= _HEALTH_SECONDS:
            self._reported = time.monotonic()
            self._health.send(Health(self.name, time.time(), counters() | rejects(), self.trouble, self.source))
        else:
            self._health.serve_late_joiners()

    def allow(self, seconds: float) -> None:
        """Extend the watchdog's deadline for this turn of the loop."""
        self._watchdog.allow(seconds)

    def allow_each(self, seconds: float) -> None:
        """Extend the watchdog's deadline for every turn from now on."""
        self._watchdog.allow_each(seconds)

    def close(self) -> None:
        """Close the channel `health`, after its last message was sent."""
        self._health.close()

    def _end(self, *_: object) -> None:
        self._asked = min(self._asked, time.monotonic())


def run(name: str, main: Callable[[Process], None], job: Job, parent: Parent | None) -> int:
    """Run a service; return its exit code.

    The code is 0 at the end of the stream or after SIGTERM, `BROKEN` if the source broke, and `REFUSED` for an error
    that would happen again.

    Parameters
    ----------
    parent : the process that started this one and that ends it; None for a process that was started by hand
    """
    if parent is not None:
        die_with(parent.pid)
    try:
        process = Process(name, job, parent.watchdog if parent else None)
        try:
            main(process)
        finally:
            process.close()
    except StreamRewoundError as error:
        _log.warning("%s", error)
        return 1
    except CatstreamError as error:
        _log.error("%s", error)
        return REFUSED
    return BROKEN if process.broken else 0


def die_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends, so that no orphan is left."""
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it ended before the kernel was told
        raise SystemExit(0)
