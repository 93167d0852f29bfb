"""Starts the processes of a run, receives their messages, restarts processes that die or hang, and ends all of them.

One thread of the program does this, however long the program takes with each frame.
"""

from __future__ import annotations

import logging
import math
import os
import random
import signal
import threading
from collections import deque
from contextlib import ExitStack
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO

from catstream.base.addresses import is_live
from catstream.base.clock import RunningClock
from catstream.errors import ServiceError, VideoError
from catstream.processes.job import Job
from catstream.processes.process import PERMANENT_FAILURE, POLL_SECONDS, SOURCE_FAILED, STOPPED_EARLY
from catstream.processes.shared import SharedMemory
from catstream.processes.start_server import NAMES, StartedProcess, start_server, starting
from catstream.wire.channels import HEALTH
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Health, Track, Tracks
from catstream.wire.newest import Subscriber
from catstream.wire.results import ResultsReceiver

RESTART_SECONDS = 0.1  #: delay of the second restart in a minute; doubled for each further one
RESTARTS, RECENT_SECONDS = 5, 60.0  #: maximum number of restarts of a process within this time
APART_SECONDS = 3.0  #: time for the run to end after one of its processes; then the process is restarted
SHUTDOWN_SECONDS = 12.0  #: timeout for all processes to end, and for the detector after the end of the stream
LEAST_SECONDS = 0.1  #: minimum for each of them, even if the others have used up the timeout
ENDED = (0, SOURCE_FAILED)  #: exit codes of a process that has ended with the run

_LAST_LINE = 2000  # bytes at the end of a log in which the last line is searched for
_STEP = 65536  # bytes of a log that are read at once; a longer line is skipped

_log = logging.getLogger(__name__)


class ProcessLog:
    """The log of a process, whose lines begin with its name: it writes to a file, and this class reads that."""

    def __init__(self, name: str, file: BinaryIO) -> None:
        self._mark = f"{name}: "
        self._file = file
        self._read = 0  # bytes that `new_lines` has returned
        self._begin = 0  # of what the process that runs now has logged

    def fileno(self) -> int:
        return self._file.fileno()

    def new_lines(self) -> list[str]:
        """The lines that the process logged since the last call, without the output of Python itself."""
        # The process writes at the position of the file, which `pread` leaves alone.
        data = os.pread(self.fileno(), _STEP, self._read)
        whole, end, _ = data.rpartition(b"\n")
        self._read += len(whole) + len(end) if end or len(data) < _STEP else len(data)
        lines = whole.decode(errors="replace").splitlines()
        return [line.removeprefix(self._mark) for line in lines if line.startswith(self._mark)]

    def begin(self) -> None:
        """Forget what an earlier process has logged, for `last_line`."""
        self._begin = os.fstat(self.fileno()).st_size

    def last_line(self) -> str:
        """The last line that the process has logged, empty if there is none."""
        size = os.fstat(self.fileno()).st_size
        text = os.pread(self.fileno(), _LAST_LINE, max(self._begin, size - _LAST_LINE))
        lines = text.decode(errors="replace").strip().splitlines()
        return lines[-1].removeprefix(self._mark) if lines else ""

    def close(self) -> None:
        self._file.close()


class Child:
    """One process of a run, the file of whose job is `job`."""

    def __init__(self, name: str, job: Path, folder: Path) -> None:
        self.name = name
        self.job = job
        self.restarts: deque[float] = deque()  #: moments
        self.process: StartedProcess | None = None  #: None until the moment `start_time`
        self.start_time = 0.0
        self.hung = False  #: whether it was killed because it made no progress
        self.silent = 0.0  #: seconds since the last iteration of its loop; once it has ended, since its end
        self._iterations = 0.0  # at the last check
        self.memory = SharedMemory()
        self.log = ProcessLog(name, (folder / f"{name}.log").open("w+b"))

    @property
    def code(self) -> int | None:
        """Exit code of the process, None if it runs or is to be started."""
        return self.process.poll() if self.process is not None else None

    def start(self, after: int) -> None:
        """Start the process; the program has the frames up to message `after`."""
        self.end()
        self.memory.consumer.after = self.memory.consumer.read = after
        self.memory.watchdog.allow()
        self.silent, self.hung = 0.0, False
        self.log.begin()
        log, memory = self.log.fileno(), self.memory.handle
        self.process = start_server().start(self.name, self.job, log, memory, restarted=bool(self.restarts))

    def ending(self, code: int) -> str:
        """Describe how the process ended: the signal or the exit code.

        The last line of its log is included only if it exited by itself or aborted: a killed process logs nothing.
        """
        if code == STOPPED_EARLY:
            return "another program asked it to end with a signal"
        if self.hung:
            return "killed after it made no progress"
        if self.process is not None and self.process.lost:
            server = self.process.server_code
            return f"with the start server: {_status(server)}" if server is not None else "with the start server"
        last = self.log.last_line() if code > 0 or code == -signal.SIGABRT else ""
        return f"{_status(code)}: {last}" if last else _status(code)

    def check(self, seconds: float) -> bool:
        """Return True if the loop has been stuck for longer than the watchdog limit."""
        before, self._iterations = self._iterations, self.memory.watchdog.iterations
        self.silent = self.silent + seconds if before == self._iterations and self.code is None else 0.0
        return self.silent > self.memory.watchdog.patience

    def end(self) -> None:
        if self.process is not None:
            self.process.close()
            self.process = None

    def close(self) -> None:
        """Kill the process if it runs, and close the log and the shared memory."""
        self.end()
        self.log.close()
        self.memory.close()


def _status(code: int) -> str:
    """An exit code in words; of SIGKILL, which catstream did not send here, the probable cause."""
    if code >= 0:
        return f"exit code {code}"
    if code == -signal.SIGKILL:
        return "signal SIGKILL, not sent by catstream; out of memory?"
    return f"signal {signal.Signals(-code).name if -code in {*signal.Signals} else -code}"  # else real-time


class Phase(IntEnum):
    """The phases of a run, in their order; some may be left out.

    OVER      no further frames are received: the detector has ended, or a process failed repeatedly
    STOPPING  `stop` waits for the processes to end
    HURRYING  `stop` was interrupted, and waits for no process
    ENDED     all processes have ended
    """

    RUNNING, OVER, STOPPING, HURRYING, ENDED = range(5)


class Supervisor:
    """The processes of one run, and the thread that receives its tracks, its health and its end.

    A process that died or hangs is restarted: at once, then after a pause that doubles each time.

    folder  of the file of the job, of the logs, and of the state if the job has no folder for it
    after   number of the last frame that the program has, which a run that is resumed follows
    """

    def __init__(self, job: Job, folder: Path, after: int = 0) -> None:
        #: The last message of the run; None before it was received.
        self.end: End | None = None
        #: The newest health report of each process, by its name.
        self.health: dict[str, Health] = {}
        self._live = is_live(job.source)
        self._changed = threading.Condition()  # guards the frames and the phase
        self._frames: deque[Tracks] = deque()  # that were received, and not returned yet
        self._phase = Phase.RUNNING
        self._error: Exception | None = None  # that ended the run
        self._clock = RunningClock()  # of the time without progress of a process
        self._checked = self._clock()  # when the processes were checked last
        file = replace(job, state=job.state or folder, run=token_hex(8)).save(folder)
        endpoint = Endpoint.parse(job.endpoint, job.settings.run.keys)
        with starting(), ExitStack() as stack:
            self._results = stack.enter_context(ResultsReceiver(endpoint, job.settings.run.unstored_frames + 1, after))
            self._reports = stack.enter_context(Subscriber(HEALTH, endpoint))
            self._children: dict[str, Child] = {}
            for name in NAMES:
                child = self._children[name] = Child(name, file, folder)
                stack.callback(child.close)
            for child in self._children.values():
                child.start(after)
            resources = stack.pop_all()
        threading.Thread(target=self._run, args=[resources], name="catstream supervisor", daemon=True).start()

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of the running processes, by name."""
        running = {name: child.process for name, child in self._children.items()}
        return {name: pid for name, process in running.items() if process is not None and (pid := process.pid)}

    @property
    def restarts(self) -> int:
        """How many times a process was restarted."""
        return sum(len(child.restarts) for child in self._children.values())

    def next_frame(self, seconds: float = math.inf) -> dict[str, Track] | None:
        """Wait for the next frame: the tracks by object name; empty if the time is over, None after the last frame.

        ServiceError if a process fails repeatedly, or another thread has ended the run; VideoError after the last frame
        if the source failed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._phase, None if seconds == math.inf else seconds)
            if self._frames and self._phase < Phase.STOPPING:
                tracks = self._frames.popleft()
                if self.end is None:
                    self._children["detector"].memory.consumer.read = tracks.seq
                return tracks.tracks
            if self._phase is Phase.RUNNING:
                return {}
        if self._error is not None:
            raise self._error
        if self._phase >= Phase.STOPPING:
            raise ServiceError("the pipeline is closed (perhaps by another thread): create a new one")
        if self.end is not None and self.end.failed:
            raise VideoError(self.end.reason)
        return None

    def report_unwritten(self, frames: int, reason: str) -> None:
        """Report how many frames could not be written to the results, and why, with the health of the detector."""
        consumer = self._children["detector"].memory.consumer
        consumer.not_written, consumer.trouble = frames, reason.encode()[:1000]

    def stop(self) -> None:
        """End the processes in order, and receive what they still send; at once if this is interrupted."""
        self._enter(Phase.STOPPING)
        interruption: BaseException | None = None
        while self._phase < Phase.ENDED:
            try:
                self._wait(Phase.ENDED)  # of Python 3.11, a `join` that is interrupted takes the thread for ended
            except BaseException as error:
                self._enter(Phase.HURRYING)
                interruption = error
        if interruption is not None:
            raise interruption

    def _enter(self, phase: Phase) -> None:
        """Enter a phase, unless the run is in a later one."""
        with self._changed:
            self._phase = max(self._phase, phase)
            self._changed.notify_all()

    def _wait(self, phase: Phase) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._phase >= phase)

    # Methods of the thread

    def _run(self, resources: ExitStack) -> None:
        """Receive until the detector has exited after the end of the run; then wait for `stop`."""
        try:
            with resources:
                deadline = math.inf
                try:
                    while self._phase < Phase.STOPPING and self._clock() < deadline:
                        self._iterate()
                        if self.end is not None:
                            deadline = min(deadline, self._clock() + SHUTDOWN_SECONDS)
                            if self._children["detector"].code in ENDED:
                                break
                    self._receive_health()
                except Exception as error:
                    self._error = error
                self._enter(Phase.OVER)
                self._wait(Phase.STOPPING)
                self._shut_down()
        finally:
            self._enter(Phase.ENDED)

    def _iterate(self) -> None:
        """Receive the next frame or the end; at intervals, receive the health and check the processes."""
        message = self._results.receive(POLL_SECONDS)
        if isinstance(message, End):
            self.end = message
            self._children["detector"].memory.consumer.read = math.inf
        elif message is not None:
            with self._changed:
                self._frames.append(message)
                self._changed.notify()
        before, now = self._checked, self._clock()
        if now - before >= POLL_SECONDS:
            self._checked = now
            self._receive_health()
            if self.end is None and self._phase < Phase.STOPPING:
                with starting():
                    self._check_children(now, now - before)

    def _receive_health(self) -> None:
        """Receive the health reports that have arrived, and log each new problem."""
        for report in self._reports.receive_all():
            before = self.health.get(report.process)
            is_new = before is None or before.trouble != report.trouble
            is_logged = report.process == "detector" and report.counters.get("write_failed")  # by the program
            if report.trouble and is_new and not is_logged:
                _log.warning("%s: %s", report.process, report.trouble)
            self.health = self.health | {report.process: report}

    def _check_children(self, now: float, seconds: float) -> None:
        """Restart the processes that died, and kill those that hang; ServiceError if a restart is useless."""
        for child in self._children.values():
            code = child.code
            if child.process is None:
                if now >= child.start_time:
                    child.start(self._results.last)
            elif code in ENDED:
                # Only this one was asked to end, or the detector died after it sent its end and has to repeat it.
                child.silent += seconds
                if child.silent > APART_SECONDS:
                    child.start(self._results.last)
            elif code is not None:
                self._restart(child, code, now)
            elif child.check(seconds):
                _log.warning("%s made no progress for %.0f s; killing it", child.name, child.silent)
                child.process.send_signal(signal.SIGKILL)
                child.silent, child.hung = 0.0, True
        if self._live:  # a source was lost or is available again
            for line in self._children["detector"].log.new_lines():
                _log.warning("%s", line)

    def _restart(self, child: Child, code: int, now: float) -> None:
        """Restart a process that died with an exit code, or schedule that."""
        if not child.job.exists():
            raise ServiceError(
                f"the {child.name} died ({child.ending(code)}) and cannot be restarted: the folder of the run, "
                f"{child.job.parent}, was removed; start again, with TMPDIR set to a folder that nothing cleans"
            )
        if code == PERMANENT_FAILURE:
            raise ServiceError(child.log.last_line())
        child.restarts.append(now)
        recent = sum(now - moment < RECENT_SECONDS for moment in child.restarts)
        if recent > RESTARTS:
            raise ServiceError(f"the {child.name} died {recent} times in a minute (last: {child.ending(code)})")
        _log.warning("%s died (%s); restarting it", child.name, child.ending(code))
        if recent == 1:
            child.start(self._results.last)
        else:
            child.end()
            child.start_time = now + RESTART_SECONDS * 2 ** (recent - 2) * random.uniform(0.5, 1)

    def _shut_down(self) -> None:
        """End the processes, the detector first, as its last messages need the others; what does not end is killed."""
        deadline = self._clock() + SHUTDOWN_SECONDS
        for child in self._children.values():
            if child.process is None:
                continue
            child.process.send_signal(signal.SIGTERM)
            limit = max(deadline, self._clock() + LEAST_SECONDS)
            while child.code is None and self._phase < Phase.HURRYING and self._clock() < limit:
                self._iterate()
        self._receive_health()
