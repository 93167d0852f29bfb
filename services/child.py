"""One child process of a supervisor: its command, its watchdog, its log and its history of restarts."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections import deque
from pathlib import Path

from catstream.services.loop import SOURCE_FAILED
from catstream.services.start import environment, service_command
from catstream.services.watchdog import Watchdog

__all__ = ["Child"]

_STEP_SECONDS = 0.5  # the most that counts between two calls of `hangs`, as the parent itself may have been suspended
_STOPPED_SECONDS = 2.0  # a process that SIGSTOP has stopped for so long counts as hung
_LAST_LINE = 2000  # bytes at the end of the log in which the last line is searched for
_LOG_STEP = 65536  # bytes of the log that are read at once


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
    seen : moment at which it was last seen running
    killed : whether it hung and was killed
    restarts : moments of its restarts
    """

    def __init__(self, name: str, job: Path, folder: Path) -> None:
        self.name, self._job = name, job
        self.due = self.seen = 0.0
        self.killed = False
        self.restarts: deque[float] = deque()
        self.silent = 0.0  #: seconds since the count of turns last changed
        self._stopped = 0.0  # seconds of these in which it was stopped by a signal
        self._turns = 0.0
        self._watchdog = Watchdog()
        self._process: subprocess.Popen[bytes] | None = None
        self._log = (folder / f"{name}.log").open("w+b")
        self._read = 0  # bytes of the log that `new_lines` has returned

    def start(self) -> None:
        """Start the process."""
        self._watchdog.close()
        self._watchdog, self.killed = Watchdog(), False
        self._turns = self.silent = self._stopped = 0.0
        options = ["--parent", str(os.getpid()), "--watchdog", str(self._watchdog.handle)]
        options += ["--restarted"] * bool(self.restarts)
        self.seen = time.monotonic()
        self._process = subprocess.Popen(
            service_command("child", self.name, str(self._job), *options),
            env=environment(),
            stdin=subprocess.DEVNULL,
            stderr=self._log,
            pass_fds=[self._watchdog.handle],
            start_new_session=True,  # Ctrl-C is for the parent, which then ends its children in order
        )

    def schedule(self, due: float) -> None:
        """Set the moment at which a process that ended is restarted."""
        self._process, self.due = None, due

    @property
    def waits(self) -> bool:
        """Whether the process is to be started when it is due."""
        return self._process is None

    @property
    def pid(self) -> int | None:
        """Process id, None if the process does not run."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    @property
    def code(self) -> int | None:
        """Exit code of the process, None if it runs or is to be started."""
        return self._process.poll() if self._process is not None else None

    @property
    def finished(self) -> bool:
        """Whether the process ended normally, or because the source broke."""
        return self.code in (0, SOURCE_FAILED)

    def hangs(self, seconds: float) -> bool:
        """Whether the loop of the process has been stuck for too long; the last call was `seconds` ago."""
        if (turns := self._watchdog.turns) != self._turns:
            self._turns, self.silent, self._stopped = turns, 0.0, 0.0
            return False
        seconds = min(seconds, _STEP_SECONDS)
        self.silent += seconds
        self._stopped = self._stopped + seconds if self.silent > _STEP_SECONDS and self._is_stopped() else 0.0
        return self.silent > self._watchdog.patience or self._stopped > _STOPPED_SECONDS

    def _is_stopped(self) -> bool:
        with contextlib.suppress(OSError):  # the process has ended
            return Path(f"/proc/{self.pid}/stat").read_text().rpartition(") ")[2][:1] == "T"
        return False

    def terminate(self, seconds: float) -> None:
        """Ask the process to end, and wait at most `seconds` for it."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)

    def kill(self) -> None:
        """Kill the process, if it runs."""
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Kill the process if it runs, and close the log and the watchdog."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._log.close()
        self._watchdog.close()

    def new_lines(self) -> list[str]:
        """The lines that the process logged since the last call, without the output of Python itself."""
        # The child writes at the position of the file, which `pread` leaves alone.
        whole, end, _ = os.pread(self._log.fileno(), _LOG_STEP, self._read).rpartition(b"\n")
        self._read += len(whole) + len(end)
        lines, mark = whole.decode(errors="replace").splitlines(), f"{self.name}: "
        return [line.removeprefix(mark) for line in lines if line.startswith(mark)]

    def last_line(self) -> str:
        """The last line that the process logged."""
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - _LAST_LINE))
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return lines[-1].removeprefix(f"{self.name}: ") if lines else "it logged nothing"
