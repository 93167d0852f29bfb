"""The frame of every process of the pipeline: signals, health, watchdog, exit codes, and its end with the parent."""

from __future__ import annotations

import logging
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from secrets import token_hex

from catstream.base.addresses import is_live, without_password
from catstream.base.system import die_with, name_process, release_memory
from catstream.errors import CatstreamError, StreamRewoundError
from catstream.processes.ending import Ending
from catstream.processes.job import Job
from catstream.processes.shared import SharedMemory
from catstream.wire.channels import HEALTH
from catstream.wire.discovery import private_folder
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import Health, run_state
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.rejects import rejected

#: Exit code after an error that would occur again, such as an invalid setting: the process is not restarted.
PERMANENT_FAILURE = 2

#: Exit code after the source failed, for example a damaged file: the process is not restarted either.
SOURCE_FAILED = 3

#: Exit code after a signal has ended a process of a supervisor before the end of the stream: it is restarted.
STOPPED_EARLY = 4

TURN_SECONDS = 0.02  #: the longest wait in a turn of a detector; from one look at the processes of a run to the next
MESSAGE_SECONDS = 0.1  #: the longest wait of compressor and trainer for a message
HEALTH_SECONDS = 1.0  #: between two health reports of a process
_MISSING_SECONDS = 2.0  # without a health report, after which another process that was not started is named

#: Of the compressor and the trainer of a live source: the next frame does not wait for either of them. With 10, a busy
#: machine starves the compressor, until frames wait for it. A file is tracked as fast as all three processes allow.
_LIVE_NICENESS = 5

_log = logging.getLogger(__name__)


class Process:
    """The state that every process of the pipeline has.

    state            folder of the checkpoints and of the desired state; a private one, removed at the end, by default
    trouble, source  description of a current problem, and the source; both are published with the health
    ending           why and how far the process has ended
    watchdog         counts the turns of the loop
    owner            the owner of the run; None if the process was started by hand
    """

    def __init__(self, name: str, job: Job, handle: int | None = None) -> None:
        self.name, self.job, self.settings = name, job, job.settings
        endpoint = Endpoint.parse(job.endpoint or job.settings.run.endpoint, job.settings.run.keys)
        # Of processes that were started by hand, only the detector knows that a run begins.
        self.endpoint = replace(endpoint, run=job.run or (token_hex(8) if name == "detector" else ""))
        self.trouble = self.source = ""
        self.ending = Ending()
        memory = SharedMemory(handle)
        self.watchdog, self.owner = memory.watchdog, memory.owner if job.run else None
        self._stack = ExitStack()
        self._health = self._stack.enter_context(Publisher(HEALTH, self.endpoint, sender=name))
        self.state = job.state or self._stack.enter_context(private_folder())
        self._reported = 0.0

    def beat(
        self,
        counters: Callable[[], dict[str, float]],
        objects: Callable[[], dict[str, dict[str, float]]],
        now: bool = False,
    ) -> None:
        """Count a turn of the loop; once a second or `now`, publish the health and release memory; for each turn."""
        self.watchdog.beat()
        if now or time.monotonic() - self._reported >= HEALTH_SECONDS:
            self._reported = time.monotonic()
            own, state, trouble = counters() | {"rejected": float(rejected())}, None, self.trouble
            if self.name == "detector":
                state = run_state(own)[0]
                if self.owner is not None:
                    of_results = self.owner.trouble.decode(errors="replace")
                    own |= {"not_written": self.owner.not_written, "write_failed": float(bool(of_results))}
                    trouble = "; ".join(filter(None, (trouble, of_results)))
            self._health.send(Health(self.name, time.time(), own, trouble, self.source, objects(), state))
            release_memory()
        else:
            self._health.serve_late_joiners()

    def close(self) -> None:
        """Close the channel `health`, after its last message was sent."""
        self._stack.close()


def reset_process() -> None:
    """Reset the signal mask, SIGCHLD and the limit of open files, which a process inherits from its parent."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def run(
    name: str, job: Job | Path, parent: int | None = None, memory: int | None = None, *, restarted: bool = False
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
        if name != "detector" and is_live(job.source):
            os.nice(_LIVE_NICENESS)
        source = without_password(job.source)
        name_process(f"{name}:{Path(source).name}" if source else name, f"catstream {name} {source}")
        process = Process(name, job, memory)
        try:
            if parent is None:
                threading.Thread(target=_name_missing, args=(name, process.endpoint), daemon=True).start()
            service.main(process)
        finally:
            process.close()
    except StreamRewoundError as error:
        _log.warning("%s", error)
        return 1
    except CatstreamError as error:
        print(error, file=sys.stderr)  # without the name: a supervisor raises it, and does not log it too
        return PERMANENT_FAILURE
    if process.ending.failed:
        return SOURCE_FAILED
    return 0 if process.ending.ended or parent is None else STOPPED_EARLY


def _name_missing(name: str, endpoint: Endpoint) -> None:
    """Log which other processes of a pipeline that is started by hand have sent no health report."""
    missing, deadline = {*HEALTH.senders} - {name}, time.monotonic() + _MISSING_SECONDS
    with Subscriber(HEALTH, endpoint) as reports:
        while missing and (seconds := deadline - time.monotonic()) > 0:
            if (report := reports.receive(seconds)) is not None:
                missing.discard(report.process)
    if missing:
        _log.warning("waiting at %s for services/%s.py", endpoint, ".py and services/".join(sorted(missing)))
