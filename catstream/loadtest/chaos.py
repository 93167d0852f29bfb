"""Chaos: now and then a random process of a random stream is killed."""

from __future__ import annotations

import contextlib
import os
import random
import signal
from dataclasses import dataclass
from time import monotonic

from catstream.loadtest.stream import Stream

__all__ = ["Chaos", "Kill"]

_PAUSE_SECONDS = 4.0  # from one kill to the next, on average
_MAX_KILLS, _PER_SECONDS = 4, 60.0  # of one process: a supervisor gives up after more than five


@dataclass(frozen=True, slots=True)
class Kill:
    """One process that was killed.

    moment   by `time.monotonic`
    stream   its number
    process  its name
    """

    moment: float
    stream: int
    process: str


class Chaos:
    """Kills by SIGKILL; whom and when is drawn from a seed.

    kills  so far, oldest first
    """

    def __init__(self, seed: int) -> None:
        self.kills: list[Kill] = []
        self._random = random.Random(seed)
        self._due = monotonic() + self._pause()

    def step(self, streams: list[Stream]) -> None:
        """Kill one, where it is time."""
        now = monotonic()
        if now < self._due:
            return
        self._due = now + self._pause()
        candidates = [(number, name, pid) for number, stream in enumerate(streams) for name, pid in stream.pids.items()]
        candidates = [victim for victim in candidates if self._may_be_killed(now, *victim[:2])]
        if candidates:
            number, name, pid = self._random.choice(candidates)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self.kills.append(Kill(now, number, name))

    def _may_be_killed(self, now: float, stream: int, process: str) -> bool:
        before = [kill.moment for kill in self.kills if (kill.stream, kill.process) == (stream, process)]
        return sum(now - moment < _PER_SECONDS for moment in before) < _MAX_KILLS

    def _pause(self) -> float:
        return _PAUSE_SECONDS * self._random.uniform(0.5, 1.5)
