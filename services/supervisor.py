"""Starts the processes of a pipeline as children, restarts one that dies or hangs, and ends them all."""

from __future__ import annotations

import logging
import random
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from secrets import token_hex

from catstream.errors import ServiceError
from catstream.run.job import Job
from catstream.services.child import Child
from catstream.services.loop import PERMANENT_FAILURE, SOURCE_FAILED
from catstream.services.start_server import NAMES
from catstream.services.timing import (
    APART_SECONDS,
    RECENT_SECONDS,
    RESTART_SECONDS,
    RESTARTS,
    SHUTDOWN_SECONDS,
    STEP_SECONDS,
    TURN_SECONDS,
)
from catstream.video.frames import without_password
from catstream.video.source import is_live
from catstream.wire.endpoint import meeting_place, private_folder

_log = logging.getLogger(__name__)


class Supervisor:
    """The children of one pipeline.

    Call `check_children` at least ten times a second. It restarts a child that died or hangs: at once, then after a
    pause that doubles each time, and at most five times a minute.

    Parameters
    ----------
    job : the job of the run; without a state folder, the state is stored in `folder`
    folder : folder for the file of the job, and for the logs
    """

    def __init__(self, job: Job, folder: Path) -> None:
        # A restarted detector continues the timestamps of a live source, and every process the run.
        since = time.monotonic() if job.since is None else job.since
        file = replace(job, state=job.state or folder, since=since, run=token_hex(8)).save(folder)
        self._checked = time.monotonic()
        self._children: dict[str, Child] = {}
        try:
            for name in NAMES:
                self._children[name] = Child(name, file, folder)
                self._children[name].start()
        except BaseException:
            self.stop()
            raise

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of the running processes, by name."""
        return {name: child.pid for name, child in self._children.items() if child.pid is not None}

    @property
    def restarts(self) -> int:
        """How many times a child was restarted."""
        return sum(len(child.restarts) for child in self._children.values())

    @property
    def finished(self) -> bool:
        """Whether the detector has ended normally; it does so once all of its messages are stored."""
        return self._children["detector"].finished

    @property
    def failure(self) -> str:
        """Error of the source, once the detector has ended; empty if the source did not fail."""
        detector = self._children["detector"]
        return detector.log.last_line() if detector.code == SOURCE_FAILED else ""

    def new_lines(self, name: str) -> list[str]:
        """The lines that a child has logged since the last call."""
        return self._children[name].log.new_lines()

    def check_children(self, *, delivers: bool = False) -> None:
        """Restart the children that died, and kill those that hang; both are logged.

        Parameters
        ----------
        delivers : whether a message of the detector has just been received: it ends once its owner has all of them

        Raises
        ------
        ServiceError
            If a restart is useless; contains the error of the child.
        """
        if self.finished:
            return
        before, self._checked = self._checked, time.monotonic()
        seconds = min(self._checked - before, STEP_SECONDS)
        for child in self._children.values():
            now = time.monotonic()
            if child.waits:
                if now >= child.due:
                    child.start()
            elif child.code is None:
                self._check_hanging(child, seconds)
            elif child.finished:
                # Only this child was asked to end, or the detector died after it sent its end and has to repeat it.
                child.apart = 0.0 if delivers else child.apart + seconds
                if child.apart > APART_SECONDS:
                    child.start()
            else:
                self._restart(child, child.code, now)

    def _check_hanging(self, child: Child, seconds: float) -> None:
        """Kill a child that has hung for too long, `seconds` after the last check."""
        child.count_turns(seconds)
        if child.hangs and not child.killed:
            _log.warning("the %s hangs, and is killed: its loop has stood still for %.1f s", child.name, child.silent)
            child.killed = True
            child.kill()

    def _restart(self, child: Child, code: int, now: float) -> None:
        """Restart a child that died with an exit code, or schedule that."""
        if code == PERMANENT_FAILURE:
            raise ServiceError(child.log.last_line())
        child.restarts.append(now)
        recent = sum(now - moment < RECENT_SECONDS for moment in child.restarts)
        if recent > RESTARTS:
            raise ServiceError(
                f"the {child.name} died {recent} times in a minute, the last time with {_ending(code)}: "
                f"{child.log.last_line()}"
            )
        _log.warning("the %s died with %s, and is restarted: %s", child.name, _ending(code), child.log.last_line())
        if recent == 1:
            child.start()
        else:
            child.schedule(now + RESTART_SECONDS * 2 ** (recent - 2) * random.uniform(0.5, 1))

    def stop(self, turn: Callable[[], object] = lambda: None) -> None:
        """End all children: each is asked to end, and killed if it does not.

        Parameters
        ----------
        turn : called while it waits; receives what the children still send
        """
        deadline = time.monotonic() + SHUTDOWN_SECONDS
        try:
            for child in self._children.values():  # the detector first: its last messages need the others
                child.terminate(max(0.1, deadline - time.monotonic()), turn)
        finally:
            for child in self._children.values():
                child.close()


def main(job: Job) -> int:
    """Run a pipeline for its subscribers until the source ends or a signal arrives; return the exit code.

    The code is `SOURCE_FAILED` if the source failed, otherwise 0.
    """
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    shown = without_password(job.source if is_live(job.source) else str(Path(job.source).absolute()))
    settings = job.settings
    with private_folder() as folder, meeting_place(settings.run.endpoint, folder, settings.run.keys, shown) as endpoint:
        supervisor = Supervisor(replace(job, endpoint=str(endpoint)), folder)
        try:
            while not supervisor.finished and not ended.wait(TURN_SECONDS):
                supervisor.check_children()
            if failure := supervisor.failure:
                _log.error("%s", failure)
        finally:
            supervisor.stop()
    return SOURCE_FAILED if failure else 0


def _ending(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
