"""The frame of every process of the pipeline: signals, health, watchdog, exit codes, and its end with the parent."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from secrets import token_hex

from catstream.errors import CatstreamError, StreamRewoundError
from catstream.messages.kinds import Health
from catstream.run.job import Job
from catstream.services.process_title import set_process_title
from catstream.services.timing import HEALTH_SECONDS, STUCK_SECONDS
from catstream.services.watchdog import Watchdog
from catstream.wire.channels import HEALTH
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher
from catstream.wire.socket import rejects

#: Exit code after an error that would occur again, such as an invalid setting: the process is not restarted.
PERMANENT_FAILURE = 2

#: Exit code after the source failed, for example a damaged file: the process is not restarted either.
SOURCE_FAILED = 3

#: Name of the compressor's subscription to the tracks if it records: the detector waits for it before the first frame.
RECORDER = "recorder"

_QUICK_SIZE = 128  # coreset size up to which one turn of compressor and trainer is short on any machine
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
_log = logging.getLogger(__name__)


class Process:
    """The state that every process of the pipeline has.

    Attributes
    ----------
    job : the job of the run
    settings, endpoint : settings and endpoint of the job
    trouble, source : description of a current problem, and the source; both are published with the health
    source_failed : whether the stream ended because the source failed
    watchdog : counts the turns of the loop
    """

    def __init__(self, name: str, job: Job, watchdog: int | None = None) -> None:
        self.name, self.job, self.settings = name, job, job.settings
        place = Endpoint.parse(job.endpoint or job.settings.run.endpoint, job.settings.run.keys)
        # Of processes that were started by hand, only the detector knows that a run begins.
        self.endpoint = replace(place, run=job.run or (token_hex(8) if name == "detector" else ""))
        self.trouble = self.source = ""
        self.source_failed = False
        # One turn of the compressor or the trainer takes a time that grows with the coreset size.
        factor = 1.0 if name == "detector" else max(1.0, (job.settings.coreset.size / _QUICK_SIZE) ** 2)
        self.watchdog = Watchdog(watchdog, STUCK_SECONDS * factor)
        self._stop_moment = float("inf")  # at which a signal asked the process to end
        self._health = Publisher(HEALTH, self.endpoint, sender=name)
        self._reported = 0.0
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)

    @property
    def stop_requested(self) -> bool:
        """Whether a signal has asked the process to end."""
        return self.seconds_since_stop >= 0

    @property
    def seconds_since_stop(self) -> float:
        """Seconds since a signal asked the process to end; negative if none has."""
        return time.monotonic() - self._stop_moment

    def beat(
        self,
        counters: Callable[[], dict[str, float]],
        objects: Callable[[], dict[str, dict[str, float]]],
        now: bool = False,
    ) -> None:
        """Reset the watchdog, and publish the health once a second or `now`; call it in each turn of a loop.

        Parameters
        ----------
        counters, objects : return the counters of the process, and those of each object
        """
        self.watchdog.beat()
        if now or time.monotonic() - self._reported >= HEALTH_SECONDS:
            self._reported = time.monotonic()
            own = counters() | rejects()
            self._health.send(Health(self.name, time.time(), own, self.trouble, self.source, objects()))
        else:
            self._health.serve_late_joiners()

    def close(self) -> None:
        """Close the channel `health`, after its last message was sent."""
        self._health.close()

    def _end(self, *_: object) -> None:
        self._stop_moment = min(self._stop_moment, time.monotonic())


def run(
    name: str, job: Job | Path, parent: int | None = None, watchdog: int | None = None, *, restarted: bool = False
) -> int:
    """Run the detector, the compressor or the trainer; return its exit code.

    The code is 0 at the end of the stream or after SIGTERM, `SOURCE_FAILED` if the source failed, and
    `PERMANENT_FAILURE` for an error that would occur again.

    Parameters
    ----------
    job : the job, or the file that contains it
    parent : id of the process with which this one ends; None for a process that was started by hand
    watchdog : descriptor of the memory of its watchdog; None to make a new one
    restarted : whether it continues the work of a process that died
    """
    if parent is not None:
        die_with(parent)
    set_process_title(name)
    log_as(name)
    service = import_module(f"catstream.services.{name}")
    service.prepare()
    try:
        job = Job.load(job) if isinstance(job, Path) else job
        job = replace(job, resume=job.resume or restarted, paused=job.paused and not restarted)
        process = Process(name, job, watchdog)
        try:
            service.main(process)
        finally:
            process.close()
    except StreamRewoundError as error:
        _log.warning("%s", error)
        return 1
    except CatstreamError as error:
        _log.error("%s", error)
        return PERMANENT_FAILURE
    return SOURCE_FAILED if process.source_failed else 0


def log_as(name: str) -> None:
    """Begin each line of the log with the name of the process; the supervisor selects the lines by it."""
    logging.basicConfig(format=f"{name}: %(message)s", level=logging.INFO, force=True)


def die_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends, so that no orphan is left."""
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent ended before the call of prctl
        raise SystemExit(0)
