"""The subscribers of a load test: processes that receive messages of pipelines, and record their arrival times."""

from __future__ import annotations

import os
from array import array
from contextlib import ExitStack
from multiprocessing.connection import Connection
from selectors import EVENT_READ, DefaultSelector
from time import monotonic, sleep
from typing import Any, Self

import numpy as np

from catstream.base.system import die_with
from catstream.base.workers import SPAWN, sigint_blocked
from catstream.client.address import Address
from catstream.errors import ServiceError
from catstream.measure.camera import Schedule
from catstream.measure.latency import Observations, Receipts, latencies_to_answer
from catstream.measure.load_result import Plan
from catstream.wire.channels import PUBLIC
from catstream.wire.messages import End, Features, Track
from catstream.wire.newest import GapCounter, Subscriber

_PER_PROCESS = 100  # more subscribers in one process would receive their messages later
_SLOW_SECONDS = 0.5  # interval between two messages of a slow subscriber
_DRAIN_SECONDS = 20.0  # timeout for fast subscribers to receive the last messages


class Subscribers:
    """The subscribers to one channel of a stream; a context manager.

    Fast subscribers read each message at once; slow ones read two messages per second.
    """

    def __init__(self, plan: Plan, stream: int, channel: str, address: Address) -> None:
        self.stream, self._channel = stream, channel
        self._processes: list[Any] = []
        self._fast: list[Connection] = []  # pipes to processes of fast subscribers
        self._slow: list[Connection] = []
        for total, pipes in ((plan.fast_subscribers, self._fast), (plan.slow_subscribers, self._slow)):
            for first in range(0, total, _PER_PROCESS):
                pipe, other = SPAWN.Pipe()
                is_slow, count = pipes is self._slow, min(_PER_PROCESS, total - first)
                task = count, is_slow, channel, address, other, os.getpid()
                self._processes.append(SPAWN.Process(target=_receive, args=task, daemon=True))
                pipes.append(pipe)

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes]

    @property
    def connected(self) -> bool:
        """True if each subscriber has received a message."""
        return all(pipe.poll() for pipe in self._fast + self._slow)

    def receipts(self, observations: Observations, schedule: Schedule, frames: int, end: float) -> Receipts:
        """Wait for the end of the pipeline, and return the measures of the fast subscribers; see `measure`."""
        times, latency, received, missed = schedule.due_times(frames), [], [], []
        numbers = {track.frame: schedule.number(track.pts or 0.0) for _, track in observations.tracks}
        deadline = monotonic() + _DRAIN_SECONDS * (End in PUBLIC[self._channel].messages)
        for pipe in self._fast:
            pipe.recv()  # reports that all are connected
            if not pipe.poll(max(0.0, deadline - monotonic())):
                pipe.send(None)  # the channel has no `End`, or it was lost
            if not pipe.poll(_DRAIN_SECONDS):
                raise ServiceError("a process of the subscribers has exited: its error is printed above")
            for receipts, gaps in pipe.recv():
                # A restarted detector reuses numbers: messages before the due time are about an earlier frame.
                arrivals = [(moment, numbers.get(frame, -1)) for frame, moment in zip(*receipts, strict=True)]
                answers = [(moment, number) for moment, number in arrivals if moment >= schedule.due(number)]
                latency.append(latencies_to_answer(times, answers, end).astype(np.float32))
                received.append(len(receipts[0]))
                missed.append(gaps)
        return Receipts(self.stream, self._channel, np.array(latency), received, missed)

    def __enter__(self) -> Self:
        with sigint_blocked():
            for process in self._processes:
                process.start()
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.join()


def _receive(count: int, is_slow: bool, channel: str, address: Address, pipe: Connection, parent: int) -> None:
    """Run `count` subscribers until the pipeline ends or the load test requests their receipts, and send these.

    The receipts are the number and the arrival time of each frame. All messages about a frame have its number.
    """
    die_with(parent)
    receipts, gaps = [(array("l"), array("d")) for _ in range(count)], [GapCounter() for _ in range(count)]
    endpoint, running, is_connected = address.resolve(), set(range(count)), False
    with ExitStack() as stack, DefaultSelector() as selector:
        for index in range(count):
            subscriber = stack.enter_context(Subscriber[Any](PUBLIC[channel], endpoint))
            selector.register(subscriber.fileno(), EVENT_READ, (index, subscriber))
        subscribers = [*selector.get_map().values()]
        selector.register(pipe, EVENT_READ)
        while running and not pipe.poll():
            # Step 1: wait for messages. A slow subscriber reads one message after each pause.
            if is_slow:
                sleep(_SLOW_SECONDS)
            for key in subscribers if is_slow else [key for key, _ in selector.select() if key.data]:
                index, subscriber = key.data
                while index in running and (message := subscriber.receive(0)) is not None:
                    # Step 2: record the first message of each frame.
                    frames, moments = receipts[index]
                    if isinstance(message, End):
                        gaps[index].end(message)
                        running.discard(index)
                        selector.unregister(key.fileobj)
                    elif message.frame not in frames[-1:]:
                        frames.append(message.frame)
                        moments.append(monotonic())
                        if isinstance(message, Track | Features):
                            gaps[index].take(message)
                    if is_slow:
                        break
            if not is_connected and all(frames for frames, _ in receipts):
                pipe.send(None)
                is_connected = True
    pipe.send([(receipt, gap.missed) for receipt, gap in zip(receipts, gaps, strict=True)])
