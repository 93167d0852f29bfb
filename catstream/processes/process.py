"""The frame of every process of the pipeline: signals, health, watchdog, exit codes, and its end with the parent."""

from __future__ import annotations

import ctypes
import logging
import mmap
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from secrets import token_hex
from typing import Self

from catstream.base.addresses import without_password
from catstream.base.workers import die_with, name_process
from catstream.errors import CatstreamError, StreamRewoundError
from catstream.jobs.job import Job
from catstream.messages.kinds import Health, run_state
from catstream.processes.start_server import reset_process
from catstream.wire.channels import HEALTH
from catstream.wire.endpoint import Endpoint, private_folder
from catstream.wire.newest import Publisher
from catstream.wire.rejects import rejects

#: Exit code after an error that would occur again, such as an invalid setting: the process is not restarted.
PERMANENT_FAILURE = 2

#: Exit code after the source failed, for example a damaged file: the process is not restarted either.
SOURCE_FAILED = 3

#: Exit code after a signal has ended a process of a supervisor before the end of the stream: it is restarted.
STOPPED_EARLY = 4

TURN_SECONDS = 0.02  #: the longest wait in a turn of a detector; from one look at the processes of a run to the next
MESSAGE_SECONDS = 0.1  #: the longest wait of compressor and trainer for a message
HEALTH_SECONDS = 1.0  #: between two health reports of a process
RUNNING_SECONDS = 10.0  #: without a turn of its loop, after which a process counts as stuck
LONG_SECONDS = 120.0  #: the same for a start, and for a step that takes long and was announced

_log = logging.getLogger(__name__)


class Watchdog(ctypes.Structure):
    """Four numbers in memory that a process shares with its supervisor; the descriptor `handle` is inherited.

    No message can be late or lost: a supervisor that was suspended reads the newest count at once, and the count stops
    with the loop of the process, even if other threads continue. A turn may take `limit` seconds.

    turns     number of turns of the loop so far
    patience  seconds that the present turn may take
    after     number of the last frame that the owner of the run had when the process was started
    read      number of the last frame that the owner of the run has read, infinite once it has received the end: a
              detector is not too far ahead of it
    """

    _fields_ = (
        ("turns", ctypes.c_double),
        ("patience", ctypes.c_double),
        ("after", ctypes.c_int64),
        ("read", ctypes.c_double),
    )
    turns: float
    patience: float
    after: int
    read: float
    handle: int
    limit: float

    @classmethod
    def opened(cls, handle: int | None = None) -> Self:
        """The numbers in the memory of a descriptor, or in new memory."""
        handle, size = os.memfd_create("watchdog") if handle is None else handle, ctypes.sizeof(cls)
        os.truncate(handle, size)
        watchdog = cls.from_buffer(mmap.mmap(handle, size))
        watchdog.handle, watchdog.limit = handle, RUNNING_SECONDS
        watchdog.allow()
        return watchdog

    def beat(self) -> None:
        """Count a turn of the loop."""
        self.allow(self.limit)

    def allow(self, seconds: float = LONG_SECONDS) -> None:
        """Announce that the present turn takes long."""
        self.patience = seconds
        self.turns += 1

    def close(self) -> None:
        """Close the file descriptor; the memory stays as long as the object."""
        os.close(self.handle)


class Process:
    """The state that every process of the pipeline has.

    state            folder of what is kept; a private one, removed at the end, of a process started without one
    trouble, source  description of a current problem, and the source; both are published with the health
    source_failed    whether the stream ended because the source failed
    has_ended        whether the process has sent or received the end of the stream
    watchdog         counts the turns of the loop
    """

    def __init__(self, name: str, job: Job, watchdog: int | None = None) -> None:
        self.name, self.job, self.settings = name, job, job.settings
        place = Endpoint.parse(job.endpoint or job.settings.run.endpoint, job.settings.run.keys)
        # Of processes that were started by hand, only the detector knows that a run begins.
        self.endpoint = replace(place, run=job.run or (token_hex(8) if name == "detector" else ""))
        self.trouble = self.source = ""
        self.source_failed = self.has_ended = False
        self.watchdog = Watchdog.opened(watchdog)
        self._stop_moment = float("inf")  # at which a signal asked the process to end
        self._stack = ExitStack()
        self._health = self._stack.enter_context(Publisher(HEALTH, self.endpoint, sender=name))
        self.state = job.state or self._stack.enter_context(private_folder())
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
        """Count a turn of the loop, and publish the health once a second or `now`; call it in each turn."""
        self.watchdog.beat()
        if now or time.monotonic() - self._reported >= HEALTH_SECONDS:
            self._reported = time.monotonic()
            own = counters() | rejects()
            state = run_state(own)[0] if self.name == "detector" else None
            self._health.send(Health(self.name, time.time(), own, self.trouble, self.source, objects(), state))
        else:
            self._health.serve_late_joiners()

    def close(self) -> None:
        """Close the channel `health`, after its last message was sent."""
        self._stack.close()

    def _end(self, *_: object) -> None:
        self._stop_moment = min(self._stop_moment, time.monotonic())


def run(
    name: str, job: Job | Path, parent: int | None = None, watchdog: int | None = None, *, restarted: bool = False
) -> int:
    """Run the detector, the compressor or the trainer; return its exit code.

    The code is 0 at the end of the stream, or after SIGTERM if the process was started by hand, without a parent;
    otherwise one of the constants above. `restarted` means that it continues the work of a process that died.
    """
    if parent is not None:
        die_with(parent)
    reset_process()
    logging.basicConfig(format=f"{name}: %(message)s", level=logging.INFO, force=True)  # the supervisor selects by it
    try:
        service = import_module(f"catstream.processes.{name}")
        job = Job.load(job) if isinstance(job, Path) else job
        job = replace(job, resume=job.resume or restarted, paused=job.paused and not restarted)
        source = without_password(job.source)
        name_process(f"{name}:{Path(source).name}" if source else name, f"catstream {name} {source}")
        process = Process(name, job, watchdog)
        try:
            service.main(process)
        finally:
            process.close()
    except StreamRewoundError as error:
        _log.warning("%s", error)
        return 1
    except CatstreamError as error:
        print(error, file=sys.stderr)  # without the name: a supervisor raises it, and does not log it too
        return PERMANENT_FAILURE
    if process.source_failed:
        return SOURCE_FAILED
    return 0 if process.has_ended or parent is None else STOPPED_EARLY
