"""One child process of a supervisor: its command, its watchdog, its log and its history of restarts."""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from catstream.services.loop import SOURCE_FAILED
from catstream.services.process_log import ProcessLog
from catstream.services.start_server import StartedProcess, StartRequest, start_server
from catstream.services.timing import LOOK_SECONDS, STEP_SECONDS, STOPPED_SECONDS
from catstream.services.watchdog import Watchdog


class Child:
    """One process of a job, which can be restarted.

    Parameters
    ----------
    name : name of the process
    job : file that contains the job
    folder : folder for the log

    Attributes
    ----------
    due : moment at which the process is to be started again, if it does not run
    apart : seconds since it has ended, in which the detector has neither ended nor delivered anything
    killed : whether it hung and was killed
    restarts : moments of its restarts
    log : what it logged
    """

    def __init__(self, name: str, job: Path, folder: Path) -> None:
        self.name, self._job = name, job
        self.due = self.apart = 0.0
        self.killed = False
        self.restarts: deque[float] = deque()
        self.silent = 0.0  #: seconds since the count of turns last changed
        self._stopped = 0.0  # seconds of these in which it was stopped by a signal
        self._turns = 0.0
        self._watchdog = Watchdog()
        self._process: StartedProcess | None = None
        self.log = ProcessLog(name, (folder / f"{name}.log").open("w+b"))

    def start(self) -> None:
        """Start the process."""
        self._end_process()
        self._watchdog.close()
        self._watchdog, self.killed = Watchdog(), False
        self._turns = self.silent = self._stopped = self.apart = 0.0
        request = StartRequest.here(self.name, self._job, restarted=bool(self.restarts))
        try:
            self._process = start_server().start(request, self.log.fileno(), self._watchdog.handle)
        except ConnectionError:  # the server has ended just now
            self._process = start_server().start(request, self.log.fileno(), self._watchdog.handle)

    def schedule(self, due: float) -> None:
        """Set the moment at which a process that ended is restarted."""
        self._end_process()
        self.due = due

    @property
    def waits(self) -> bool:
        """Whether the process is to be started when it is due."""
        return self._process is None

    @property
    def pid(self) -> int | None:
        """Process id, None if the process does not run; waits for the start of a process that is being started."""
        return (self._process.pid or None) if self._process is not None and self._process.poll() is None else None

    @property
    def code(self) -> int | None:
        """Exit code of the process, None if it runs or is to be started."""
        return self._process.poll() if self._process is not None else None

    @property
    def finished(self) -> bool:
        """Whether the process ended normally, or because the source broke."""
        return self.code in (0, SOURCE_FAILED)

    def count_turns(self, seconds: float) -> None:
        """Note whether the loop of the process has turned since the last call, for which so many seconds count."""
        if (turns := self._watchdog.turns) != self._turns:
            self._turns, self.silent, self._stopped = turns, 0.0, 0.0
            return
        self.silent += seconds
        self._stopped = self._stopped + seconds if self.silent > STEP_SECONDS and self._is_suspended else 0.0

    @property
    def hangs(self) -> bool:
        """Whether the loop of the process has been stuck for too long."""
        return self.silent > self._watchdog.patience or self._stopped > STOPPED_SECONDS

    @property
    def _is_suspended(self) -> bool:
        return self._process is not None and self._process.is_suspended

    def terminate(self, seconds: float, turn: Callable[[], object]) -> None:
        """Ask the process to end, and wait at most `seconds` for it; `turn` is called again and again meanwhile."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            deadline = time.monotonic() + seconds
            while not self._process.wait(LOOK_SECONDS) and time.monotonic() < deadline:
                turn()

    def kill(self) -> None:
        """Kill the process, if it runs; also its start server if a signal has stopped that."""
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Kill the process if it runs, and close the log and the watchdog."""
        self._end_process()
        self.log.close()
        self._watchdog.close()

    def _end_process(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None
