"""Groups of fast, slow and frozen subscribers in processes of their own."""

from __future__ import annotations

import os
import signal
from collections.abc import MutableSequence
from contextlib import ExitStack
from time import monotonic, sleep
from typing import Any, Self

from catstream.messages.kinds import End
from catstream.services.process import SPAWN, die_with, sigint_blocked
from catstream.wire.channels import TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import GapCounter, Subscriber

_PER_PROCESS = 20  # subscribers in one process, because most machines cannot run a process for each
#: Maximum number of messages that a subscriber reads at once, and seconds between two reads.
_QUICK, _SLOW = (64, 0.05), (1, 0.5)
_DRAIN_SECONDS = 20.0  # time-out for fast subscribers to receive the last messages


class Subscribers:
    """Subscribers to the tracks of one pipeline; a context manager.

    They run with idle priority, and the fast ones read twenty times per second, so that they take little processor time
    from the pipeline.

    Parameters
    ----------
    endpoint, keys : endpoint and client keys of the pipeline
    readers : total number of subscribers
    slow : number of subscribers that read two messages per second
    frozen : number of subscribers that are stopped by `freeze`
    """

    def __init__(self, endpoint: str, readers: int, *, slow: int = 0, frozen: int = 0, keys: str = "") -> None:
        self._quick, self._readers = readers - slow - frozen, readers
        self._received, self._missed = (SPAWN.RawArray("l", max(readers, 1)) for _ in range(2))
        self._frozen_since = 0.0  # time of `freeze`
        self._groups: list[list[Any]] = []
        first = 0
        for size, pace in ((self._quick, _QUICK), (slow, _SLOW), (frozen, _QUICK)):
            self._groups.append([])
            for begin in range(first, first + size, _PER_PROCESS):
                numbers = range(begin, min(begin + _PER_PROCESS, first + size))
                arguments = (endpoint, keys, numbers, pace, self._received, self._missed, os.getpid())
                self._groups[-1].append(SPAWN.Process(target=_read_until_end, args=arguments, daemon=True))
            first += size

    @property
    def pids(self) -> list[int]:
        return [process.pid for group in self._groups for process in group]

    @property
    def connected(self) -> bool:
        """Whether each subscriber has received a track."""
        return all(self._received[: self._readers])

    @property
    def frozen_seconds(self) -> float:
        """Seconds since `freeze`, 0 before it."""
        return monotonic() - self._frozen_since if self._frozen_since else 0.0

    def freeze(self) -> None:
        """Stop the processes of the subscribers to be frozen, if all are connected."""
        if not self._frozen_since and self._groups[2] and self.connected:
            for process in self._groups[2]:
                os.kill(process.pid, signal.SIGSTOP)
            self._frozen_since = monotonic()

    def wait(self) -> None:
        """Wait until each fast subscriber has received the end, with a time-out."""
        deadline = monotonic() + _DRAIN_SECONDS
        for process in self._groups[0]:
            process.join(max(0.0, deadline - monotonic()))

    def received(self) -> list[int]:
        """Return the number of frames whose tracks each fast subscriber has received."""
        return list(self._received[: self._quick])

    def missed(self) -> list[int]:
        """Return the number of frames whose tracks each fast subscriber has missed, by the gaps in `seq`."""
        return list(self._missed[: self._quick])

    def __enter__(self) -> Self:
        with sigint_blocked():
            for group in self._groups:
                for process in group:
                    process.start()
        return self

    def __exit__(self, *_: object) -> None:
        for group in self._groups:
            for process in group:
                process.kill()
                process.join()


def _read_until_end(
    endpoint: str,
    keys: str,
    numbers: range,
    pace: tuple[int, float],
    received: MutableSequence[int],
    missed: MutableSequence[int],
    parent: int,
) -> None:
    """Run some of the subscribers until the pipeline ends."""
    die_with(parent)
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with ExitStack() as stack:
        readers = {
            number: stack.enter_context(Subscriber(TRACKS, Endpoint.parse(endpoint, keys))) for number in numbers
        }
        gaps = {number: GapCounter() for number in numbers}
        last = dict.fromkeys(numbers, 0)  # number of the last frame: the tracks of all objects in it have the same
        most, pause = pace
        while readers:
            for number, reader in list(readers.items()):
                for _ in range(most):
                    if (message := reader.receive(0)) is None:
                        break
                    gaps[number].take(message.seq)
                    missed[number] = gaps[number].missed
                    if isinstance(message, End):
                        del readers[number]
                        break
                    if message.seq != last[number]:
                        received[number] += 1
                        last[number] = message.seq
            sleep(pause)
