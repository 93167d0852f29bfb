"""The subscribers of a load test: processes that receive the messages of a pipeline, and record when they arrive."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from selectors import EVENT_READ, DefaultSelector
from time import monotonic, sleep
from typing import Any, NamedTuple, Self

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.system import die_with
from catstream.base.workers import SPAWN, sharing, sigint_blocked
from catstream.client.address import Address
from catstream.measure.camera import Schedule
from catstream.measure.latency import Observations, Receipts, latencies
from catstream.measure.load_result import Plan
from catstream.wire.channels import PUBLIC
from catstream.wire.messages import End, Features, Track
from catstream.wire.newest import GapCounter, Subscriber

_PER_PROCESS = 100  # one process with 500 subscribers receives their messages later than five with 100
_SLOW_SECONDS = 0.5  # between two messages of a slow subscriber
_MORE_FRAMES = 1000  # of the still image and of repeats after a restart, which have no number in the schedule
_DRAIN_SECONDS = 20.0  # timeout for fast subscribers to receive the last messages


class _Record(NamedTuple):
    """Memory that the processes of the subscribers share with the load test.

    begin : number of the first frame whose receipt is recorded
    received, missed : numbers of frames, int (subscribers,)
    moments : time of the receipt of each frame from `begin` on, 0 if there was none, float64 (fast * frames,)
    frames : number of frames for which there is memory
    """

    begin: Any
    received: Any
    missed: Any
    moments: Any
    frames: int

    @property
    def rows(self) -> Float64:
        """`moments` as an array, float64 (fast, frames)."""
        return np.frombuffer(self.moments).reshape(-1, self.frames)


class Subscribers:
    """The subscribers to one channel of a stream; a context manager.

    Fast ones wait for a message as a program does; slow ones read two messages per second.
    """

    def __init__(self, plan: Plan, stream: int, channel: str, address: Address) -> None:
        self._stream, self._channel, self._fast = stream, channel, plan.subscribers - plan.slow_subscribers
        frames = plan.frames + _MORE_FRAMES
        with sharing():
            begin, moments = SPAWN.RawValue("l", 1 << 62), SPAWN.RawArray("d", self._fast * frames)
            received, missed = (SPAWN.RawArray("l", plan.subscribers) for _ in range(2))
        self._record = _Record(begin, received, missed, moments, frames)

        def processes(numbers: range, is_slow: bool) -> list[Any]:
            parts = [numbers[first : first + _PER_PROCESS] for first in range(0, len(numbers), _PER_PROCESS)]
            rest = is_slow, channel, address, self._record, os.getpid()
            return [SPAWN.Process(target=_receive, args=(part, *rest), daemon=True) for part in parts]

        self._fast_processes = processes(range(self._fast), is_slow=False)
        self._processes = [*self._fast_processes, *processes(range(self._fast, plan.subscribers), is_slow=True)]

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes]

    @property
    def connected(self) -> bool:
        """True if each subscriber has received a message."""
        return all(self._record.received)

    def begin(self, streams: Sequence[Observations]) -> None:
        """Record the receipts of frames from the newest tracked one of the stream on."""
        self._record.begin.value = streams[self._stream].tracks[-1][1].frame

    def wait(self) -> None:
        """Wait until each fast subscriber has received the end, with a timeout; some channels have no end."""
        deadline = monotonic() + _DRAIN_SECONDS * (End in PUBLIC[self._channel].messages)
        for process in self._fast_processes:
            process.join(max(0.0, deadline - monotonic()))

    def receipts(
        self, streams: Sequence[Observations], schedules: Sequence[Schedule], due: Sequence[int], end: float
    ) -> Receipts:
        """Return the measures of the fast subscribers; the parameters are those of `measure`, for all streams."""
        schedule, frames = schedules[self._stream], due[self._stream]
        times, latency = schedule.due_times(frames), np.empty((self._fast, frames), np.float32)
        tracks = [track for _, track in streams[self._stream].tracks]
        columns = np.array([track.frame for track in tracks], int) - self._record.begin.value
        numbers = np.array([schedule.number(track.pts or 0.0) for track in tracks], int)
        is_used = (columns >= 0) & (columns < self._record.frames) & (numbers >= 0) & (numbers < frames)
        for number, moments in enumerate(self._record.rows if self._fast else ()):
            first = np.zeros(frames)
            first[numbers[is_used]] = moments[columns[is_used]]
            latency[number] = latencies(times, np.where(first > 0, first, np.inf), end)
        received, missed = (list(values[: self._fast]) for values in (self._record.received, self._record.missed))
        return Receipts(self._stream, self._channel, latency, received, missed)

    def __enter__(self) -> Self:
        with sigint_blocked():
            for process in self._processes:
                process.start()
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.join()


def _receive(numbers: range, is_slow: bool, channel: str, address: Address, record: _Record, parent: int) -> None:
    """Run some of the subscribers until the pipeline ends."""
    die_with(parent)
    endpoint, gaps, last = address.resolve(), [GapCounter() for _ in numbers], [-1] * len(numbers)
    with ExitStack() as stack, DefaultSelector() as selector:
        for index in range(len(numbers)):
            subscriber = stack.enter_context(Subscriber[Any](PUBLIC[channel], endpoint))
            selector.register(subscriber.fileno(), EVENT_READ, (index, subscriber))
        while subscribers := selector.get_map():
            # Step 1: wait for messages. A slow subscriber reads one message, which need not be new, in each pause.
            if is_slow:
                sleep(_SLOW_SECONDS)
            ready = [*subscribers.values()] if is_slow else [key for key, _ in selector.select()]
            for key in ready:
                index, subscriber = key.data
                while (message := subscriber.receive(0)) is not None:
                    # Step 2: count frames. The messages about all objects in a frame have the same number.
                    moment, number = monotonic(), numbers[index]
                    if isinstance(message, End):
                        gaps[index].end(message)
                        selector.unregister(key.fileobj)
                    elif message.frame != last[index]:
                        last[index] = message.frame
                        record.received[number] += 1
                        if isinstance(message, Track | Features):
                            gaps[index].take(message)
                        # Step 3: record the receipt; a restarted detector may repeat a frame, or reuse its number.
                        column = message.frame - record.begin.value
                        if not is_slow and 0 <= column < record.frames:
                            record.moments[number * record.frames + column] = moment
                    record.missed[number] = gaps[index].missed
                    if is_slow or isinstance(message, End):
                        break
