"""Starts the processes of a pipeline as children, restarts one that dies, and leaves none behind."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import signal
import subprocess
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from catstream.box import Box
from catstream.errors import ServiceError
from catstream.services.loop import BROKEN, REFUSED
from catstream.services.start import environment, service_command
from catstream.services.watchdog import Watchdog
from catstream.settings import Settings
from catstream.video.frames import without_password
from catstream.video.source import ALL_FRAMES, is_live
from catstream.wire.endpoint import meeting_place, private_folder

__all__ = ["NAMES", "Supervisor", "main"]

#: The processes, in the order they end.
NAMES = ("detector", "compressor", "trainer")

_RESTARTS, _PER_SECONDS = 5, 60.0
_FIRST_PAUSE = 0.1
_FAREWELL_SECONDS = 12.0
_APART_SECONDS = 3.0  # between the ends of compressor and detector, where both have ended well
_BLINK_SECONDS = 0.5  # that count at most from one look at the children to the next: who slept longer saw nothing
_STOPPED_SECONDS = 2.0  # that a process may stand still as SIGSTOP makes it, whatever it was doing
_LAST_WORDS = 2000  # bytes of a child's log that may hold why it died
_NEWS = 65536  # bytes of it that are looked through at once

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Child:
    """One process and its history."""

    name: str
    log: IO[bytes]
    watchdog: Watchdog = field(default_factory=Watchdog)
    process: subprocess.Popen[bytes] | None = None
    restarts: deque[float] = field(default_factory=deque)
    due: float = 0.0
    seen: float = 0.0  # when it last ran
    told: int = 0  # bytes of the log that were news
    turns: float = 0.0  # of its loop, when they were last counted
    silent: float = 0.0  # seconds since the count last changed
    stopped: float = 0.0  # of which it was stopped
    hung: bool = False  # and was killed for it

    @property
    def finished(self) -> bool:
        return self.process is not None and self.process.poll() in (0, BROKEN)

    def hangs(self, seconds: float) -> bool:
        """Whether its loop has stood still for too long, having been watched for so many seconds more."""
        turns = self.watchdog.turns
        if turns != self.turns:
            self.turns, self.silent, self.stopped = turns, 0.0, 0.0
            return False
        self.silent += seconds
        self.stopped = self.stopped + seconds if self.silent > _BLINK_SECONDS and self._is_stopped() else 0.0
        return self.silent > self.watchdog.patience or self.stopped > _STOPPED_SECONDS

    def _is_stopped(self) -> bool:
        with contextlib.suppress(OSError):  # it is gone
            return Path(f"/proc/{self.process and self.process.pid}/stat").read_text().rpartition(") ")[2][:1] == "T"
        return False

    def news(self) -> list[str]:
        """The lines that it logged since the last time, without what Python says by itself."""
        # Its place in the file is the child's, which writes there: it stays.
        whole, end, _ = os.pread(self.log.fileno(), _NEWS, self.told).rpartition(b"\n")
        self.told += len(whole) + len(end)
        lines, mark = whole.decode(errors="replace").splitlines(), f"{self.name}: "
        return [line.removeprefix(mark) for line in lines if line.startswith(mark)]

    def last_words(self) -> str:
        """The last line that it logged."""
        self.log.seek(0, os.SEEK_END)
        self.log.seek(max(0, self.log.tell() - _LAST_WORDS))
        lines = self.log.read().decode(errors="replace").strip().splitlines()
        return lines[-1].removeprefix(f"{self.name}: ") if lines else "it said nothing"


class Supervisor:
    """The children of one pipeline.

    Call `check` ten times a second: it restarts who died or hangs, after a pause that doubles, at most 5 times a
    minute each.

    Parameters
    ----------
    box : of the object in the first frame, or None
    settings : with the endpoint where the processes meet
    folder : where logs are kept while the pipeline runs
    model : file of what was learned of the object before; without this or a box one is waited for
    owned : whether somebody takes every track from the channel `results`
    part : which frames of the source there are to follow
    record : file to write all that travels to, or to go on with
    state : where what was learned is kept; in `folder` where None
    resume : whether the pipeline goes on with that
    since : moment of `time.monotonic` that the times of a live source count from, now where None
    """

    def __init__(
        self,
        source: str,
        box: Box | None,
        settings: Settings,
        folder: Path,
        *,
        model: Path | None = None,
        owned: bool,
        part: slice = ALL_FRAMES,
        record: Path | None = None,
        state: Path | None = None,
        resume: bool = False,
        since: float | None = None,
    ) -> None:
        self._source, self._settings, self._owned = source, settings, owned
        self._state, self._resume = state or folder, resume
        self._object = ["--box", ",".join(map(repr, box))] if box is not None else []
        self._model = ["--model", str(model)] if model is not None else []
        self._part = {"--start": part.start, "--end": part.stop, "--stride": part.step}
        self._record = record
        # A restarted detector goes on with the times of a live source.
        self._since = time.monotonic() if since is None else since
        self._checked = time.monotonic()
        self._children = {name: _Child(name, (folder / f"{name}.log").open("w+b")) for name in NAMES}
        for child in self._children.values():
            self._start(child)

    @property
    def pids(self) -> dict[str, int]:
        """Process id by name, of those that run."""
        running = ((name, child.process) for name, child in self._children.items())
        return {name: process.pid for name, process in running if process is not None and process.poll() is None}

    @property
    def restarts(self) -> int:
        """How often a child was restarted."""
        return sum(len(child.restarts) for child in self._children.values())

    @property
    def finished(self) -> bool:
        """Whether all is done: the detector has ended well, which it does once all that it sent is stored."""
        return self._children["detector"].finished

    @property
    def failure(self) -> str:
        """Why the source broke, once all is done; empty where it did not."""
        detector = self._children["detector"]
        broke = detector.process is not None and detector.process.poll() == BROKEN
        return detector.last_words() if broke else ""

    def news(self, name: str) -> list[str]:
        """What a child logged since the last time that this was asked."""
        return self._children[name].news()

    def check(self) -> None:
        """Restart who died, kill who hangs, and log it.

        Raises
        ------
        ServiceError
            Where one would only die again; says why.
        """
        if self.finished:
            return
        detector = self._children["detector"]
        before, self._checked = self._checked, time.monotonic()
        watched = min(self._checked - before, _BLINK_SECONDS)
        for child in self._children.values():
            now = time.monotonic()
            if child.process is None:
                if now >= child.due:
                    self._start(child)
                continue
            code = child.process.poll()
            if code is None:
                child.seen = now
                if child.hangs(watched) and not child.hung:
                    _log.warning("the %s hangs: nothing came of it for %.1f s", child.name, child.silent)
                    child.hung = True
                    child.process.kill()
                continue
            if child.finished:
                # It was told to end, and the detector was not; or that died after its end, and repeats it.
                if child is not detector and now - child.seen > _APART_SECONDS:
                    self._start(child)
                continue
            if code == REFUSED:
                raise ServiceError(child.last_words())
            child.restarts.append(now)
            recent = sum(now - moment < _PER_SECONDS for moment in child.restarts)
            if recent > _RESTARTS:
                raise ServiceError(
                    f"the {child.name} died {recent} times in a minute, the last time with {_ending(code)}: "
                    f"{child.last_words()}"
                )
            _log.warning("the %s died with %s, and is restarted: %s", child.name, _ending(code), child.last_words())
            pause = _FIRST_PAUSE * 2 ** (recent - 1) * random.uniform(0.5, 1)
            child.process, child.due = None, now + pause

    def stop(self) -> None:
        """End all children: asked first, killed where they do not listen."""
        deadline = time.monotonic() + _FAREWELL_SECONDS
        try:
            for child in self._children.values():
                if child.process is None or child.process.poll() is not None:
                    continue
                child.process.send_signal(signal.SIGTERM)
                # The detector's last messages need the others: they are asked once it is gone.
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.process.wait(max(0.1, deadline - time.monotonic()))
        finally:
            for child in self._children.values():
                if child.process is not None and child.process.poll() is None:
                    child.process.kill()
                    child.process.wait()
                child.log.close()
                child.watchdog.close()

    def _start(self, child: _Child) -> None:
        child.watchdog.close()
        child.watchdog, child.hung = Watchdog(), False
        child.turns, child.silent, child.stopped = 0.0, 0.0, 0.0
        watched = ["--parent", str(os.getpid()), "--watchdog", str(child.watchdog.handle)]
        command = service_command(*watched, child.name)
        for pair in self._settings.changed():
            command += ["--set", pair]
        if child.name == "detector":
            command += [self._source, *self._object, "--since", repr(self._since)]
            for option, number in self._part.items():
                command += [] if number is None else [option, str(number)]
            command += ["--owned"] * self._owned + ["--resume"] * (self._resume or bool(child.restarts))
            command += ["--recorded"] * (self._record is not None)
        if child.name != "trainer":  # it holds nothing
            command += ["--state", str(self._state), *self._model]
        if child.name == "compressor" and self._record is not None:
            command += ["--record", str(self._record)]
        child.seen = time.monotonic()
        child.process = subprocess.Popen(
            command,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stderr=child.log,
            pass_fds=[child.watchdog.handle],
            start_new_session=True,  # Ctrl-C is for the parent, which then ends them in order
        )


def main(source: str, settings: Settings, box: Box | None, model: Path | None, part: slice = ALL_FRAMES) -> int:
    """Run a pipeline for whoever subscribes, until the source ends or a signal comes.

    Returns
    -------
    the exit code: `BROKEN` where the source broke, 0 otherwise
    """
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    shown = without_password(source if is_live(source) else str(Path(source).absolute()))
    with private_folder() as folder, meeting_place(settings.run.endpoint, folder, settings.run.keys, shown) as endpoint:
        settings = settings.but({"run.endpoint": str(endpoint)})
        supervisor = Supervisor(source, box, settings, folder, model=model, owned=False, part=part)
        try:
            while not supervisor.finished and not ended.wait(0.05):
                supervisor.check()
            if failure := supervisor.failure:
                _log.error("%s", failure)
        finally:
            supervisor.stop()
    return BROKEN if failure else 0


def _ending(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
