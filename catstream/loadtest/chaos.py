"""Kills random processes of random streams, or random nodes of a fleet, at random times."""

from __future__ import annotations

import contextlib
import os
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from catstream.loadtest.stream import Stream
from catstream.messages import FleetStatus, StreamStatus

__all__ = ["Chaos", "Kill", "NodeChaos"]

_PAUSE_SECONDS = 4.0  # mean time between two kills
_RECOVERY_SECONDS = 60.0  # for the streams of a killed node to run elsewhere, before it is started again anyway
_MAX_KILLS, _PER_SECONDS = 4, 60.0  # for each process: the supervisor gives up after more than five deaths


@dataclass(frozen=True, slots=True)
class Kill:
    """A process of a stream that was killed, or the node on which the stream ran.

    moment   time by `time.monotonic`
    stream   number of the stream
    process  name of the process, or of the node
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
        self._due = monotonic() + _pause(self._random)

    def step(self, streams: list[Stream]) -> None:
        """Kill a process if a kill is due."""
        now = monotonic()
        if now < self._due:
            return
        self._due = now + _pause(self._random)
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


class NodeChaos:
    """Kills one node at a time, and starts it again after its streams run elsewhere; all is drawn from a seed.

    Parameters
    ----------
    streams : names of all streams of the fleet
    kill, start : kill a node by its name, and start it again

    Attributes
    ----------
    kills : one for each stream that ran on a killed node, oldest first
    """

    def __init__(
        self, seed: int, streams: list[str], kill: Callable[[str], None], start: Callable[[str], None]
    ) -> None:
        self.kills: list[Kill] = []
        self._streams, self._kill, self._start = streams, kill, start
        self._random = random.Random(seed)
        self._due = monotonic() + _pause(self._random)
        self._killed, self._hit = "", dict[str, StreamStatus]()

    def step(self, status: FleetStatus, *, may_kill: bool = True) -> None:
        """Kill a node if a kill is due, or start the killed one again.

        Parameters
        ----------
        status : state of the fleet, asked for after the previous step
        may_kill : whether another node may be killed
        """
        now = monotonic()
        if self._killed:
            if now > self._due or all(_has_recovered(status, before) for before in self._hit.values()):
                self._start(self._killed)
                self._killed, self._due = "", monotonic() + _pause(self._random)
        elif may_kill and now > self._due and all(stream.state == "running" for stream in status.streams.values()):
            self._killed = self._random.choice(sorted({stream.node for stream in status.streams.values()}))
            self._hit = {name: stream for name, stream in status.streams.items() if stream.node == self._killed}
            self._due = now + _RECOVERY_SECONDS
            self._kill(self._killed)
            self.kills += [Kill(now, self._streams.index(name), self._killed) for name in sorted(self._hit)]


def _has_recovered(status: FleetStatus, before: StreamStatus) -> bool:
    """Whether a stream runs in another pipeline than before."""
    stream = status.streams.get(before.name, before)
    return stream.token > before.token and stream.state == "running"


def _pause(generator: random.Random) -> float:
    """Seconds to the next kill."""
    return _PAUSE_SECONDS * generator.uniform(0.5, 1.5)
