"""Kills random processes of random streams at random times."""

from __future__ import annotations

import contextlib
import os
import random
import signal
from dataclasses import dataclass
from time import monotonic

from catstream.applications.loadtest.stream import Stream

__all__ = ["Chaos", "Kill"]

_PAUSE_SECONDS = 4.0  # mean time between two kills
_MAX_KILLS, _PER_SECONDS = 4, 60.0  # for each process: the supervisor gives up after more than five deaths


@dataclass(frozen=True, slots=True)
class Kill:
    """A process of a stream that was killed.

    moment   time by `time.monotonic`
    stream   number of the stream
    process  name of the process
    """

    moment: float
    stream: int
    process: str

    def __str__(self) -> str:
        return f"{self.process} of stream {self.stream}"


class Chaos:
    """Kills processes by SIGKILL; victims and times are drawn from a seed.

    kills  the kills so far, oldest first
    """

    def __init__(self, seed: int) -> None:
        self.kills: list[Kill] = []
        self._random = random.Random(seed)
        self._due = monotonic() + self._pause()

    def step(self, streams: list[Stream]) -> None:
        """Kill a process if a kill is due."""
        now = monotonic()
        if now < self._due:
            return
        self._due = now + self._pause()
        recent = [(kill.stream, kill.process) for kill in self.kills if now - kill.moment < _PER_SECONDS]
        candidates = [
            (number, name, pid)
            for number, stream in enumerate(streams)
            for name, pid in stream.pids.items()
            if recent.count((number, name)) < _MAX_KILLS
        ]
        if candidates:
            number, name, pid = self._random.choice(candidates)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self.kills.append(Kill(now, number, name))

    def _pause(self) -> float:
        """Seconds to the next kill."""
        return _PAUSE_SECONDS * self._random.uniform(0.5, 1.5)
