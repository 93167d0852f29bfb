"""The common part of every process of the pipeline: signals, health, watchdog, exit codes, and parent death."""

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

#: Exit code after an error that a restart would repeat, such as an invalid setting: the process is not restarted.
PERMANENT_FAILURE = 2

#: Exit code after the source failed, for example a damaged file: the process is not restarted.
SOURCE_FAILED = 3

#: Exit code after a signal has ended a supervised process before the end of the stream: it is restarted.
STOPPED_EARLY = 4

POLL_SECONDS = 0.02  #: polling interval of detector and supervisor
MESSAGE_SECONDS = 0.1  #: timeout of compressor and trainer for a message
HEALTH_SECONDS = 1.0  #: interval between two health reports of a process
_MISSING_SECONDS = 2.0  # time after which processes without a health report are logged as missing

#: Niceness of compressor and trainer for a live source, because frames do not wait for them. At 10, a busy machine
#: starves the compressor until frames have to wait. For a file, all three processes limit the speed.
_LIVE_NICENESS = 5

_log = logging.getLogger(__name__)


class Process:
    """The common state of the processes of the pipeline."""

    def __init__(self, name: str, job: Job, handle: int | None = None) -> None:
        self.name, self.job, self.settings = name, job, job.settings
        endpoint = Endpoint.parse(job.endpoint or job.settings.run.endpoint, job.settings.run.keys)
        # If the processes were started manually, the detector creates the id of the run.
        self.endpoint = replace(endpoint, run=job.run or (token_hex(8) if name == "detector" else ""))
        self.trouble = ""  #: description of a current problem, published with the health
        self.source = ""  #: the source, published with the health
        self.ending = Ending()
        memory = SharedMemory(handle)
        self.watchdog = memory.watchdog
        self.consumer = memory.consumer if job.run else None  #: None if the process was started manually
        self._stack = ExitStack()
        self._health = self._stack.enter_context(Publisher(HEALTH, self.endpoint, sender=name))
        #: Folder of the checkpoints and of the desired state; by default a private one, removed at the end.
        self.state = job.state or self._stack.enter_context(private_folder())
        self._reported = 0.0

    def beat(
        self,
        counters: Callable[[], dict[str, float]],
        objects: Callable[[], dict[str, dict[str, float]]],
        now: bool = False,
    ) -> None:
        """Count an iteration of the loop; once a second, or if `now`, publish the health and release memory."""
        self.watchdog.beat()
        if now or time.monotonic() - self._reported >= HEALTH_SECONDS:
            self._reported = time.monotonic()
            own, state, trouble = counters() | {"rejected": float(rejected())}, None, self.trouble
            if self.name == "detector":
                state = run_state(own)[0]
                if self.consumer is not None:
                    write_error = self.consumer.trouble.decode(errors="replace")
                    own |= {"not_written": self.consumer.not_written, "write_failed": float(bool(write_error))}
                    trouble = "; ".join(filter(None, (trouble, write_error)))
            self._health.send(Health(self.name, time.time(), own, trouble, self.source, objects(), state))
            release_memory()
        else:
            self._health.serve_late_joiners()

    def close(self) -> None:
        """Close the channel `health`, and remove a private state folder."""
        self._stack.close()


def reset_process() -> None:
    """Reset the inherited signal mask and handler of SIGCHLD, and raise the limit of open files to its maximum."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def run(
    name: str, job: Job | Path, parent: int | None = None, memory: int | None = None, *, restarted: bool = False
) -> int:
    """Run the detector, the compressor or the trainer; return its exit code.

    The code is 0 at the end of the stream, or after SIGTERM without a `parent`, as the process was started manually;
    otherwise one of the constants above. A `restarted` process continues the work of one that died.
    """
    if parent is not None:
        die_with(parent)
    reset_process()
    logging.basicConfig(format=f"{name}: %(message)s", level=logging.INFO, force=True)  # supervisor: `ProcessLog`
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
        print(error, file=sys.stderr)  # without the prefix, so the supervisor does not log it before it raises it
        return PERMANENT_FAILURE
    if process.ending.failed:
        return SOURCE_FAILED
    return 0 if process.ending.ended or parent is None else STOPPED_EARLY


def _name_missing(name: str, endpoint: Endpoint) -> None:
    """Log which other processes of a manually started pipeline have sent no health report."""
    missing, deadline = {*HEALTH.senders} - {name}, time.monotonic() + _MISSING_SECONDS
    with Subscriber(HEALTH, endpoint) as reports:
        while missing and (seconds := deadline - time.monotonic()) > 0:
            if (report := reports.receive(seconds)) is not None:
                missing.discard(report.process)
    if missing:
        _log.warning("waiting at %s for services/%s.py", endpoint, ".py and services/".join(sorted(missing)))
