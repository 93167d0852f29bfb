"""Waits for sockets, in programs with and without an event loop.

What has to wait is written once, as a generator: it yields each `Wait`, and returns its result. `finish` runs it and
blocks in each wait, `finish_async` runs it in an asyncio event loop.
"""

from __future__ import annotations

import asyncio
import select
import threading
from collections.abc import Generator, Sequence
from typing import NamedTuple, TypeVar

from catstream.errors import ServiceError

Result = TypeVar("Result")


class Wait(NamedTuple):
    """A wait until something may have arrived at one of the sockets (their descriptors), or for so many seconds."""

    sockets: Sequence[int]
    seconds: float


class Turns:
    """The turns of the loops that read the same sockets: one at a time, as ZeroMQ requires, and none once closed.

    So any thread, task or signal handler may close the sockets while another one waits for them.

    Parameters
    ----------
    owner : what the sockets belong to, named in the error: "pipeline"
    """

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._lock = threading.RLock()  # a signal handler may close in the middle of a turn
        self._closed = False

    def run(self, steps: Generator[Wait, None, Result]) -> Generator[Wait, None, Result]:
        """Run the steps, one turn of the lock for each; yields their waits, and returns their result.

        Raises
        ------
        ServiceError
            Once `close` was called.
        """
        while True:
            with self._lock:
                if self._closed:
                    raise ServiceError(
                        f"the {self._owner} was closed, perhaps by another thread or task: make another one to go on"
                    )
                try:
                    wait = next(steps)
                except StopIteration as stop:
                    return stop.value  # type: ignore[no-any-return]
            yield wait

    def close(self) -> None:
        """Wait until a turn of another thread is over, and allow no further ones: the sockets can then be closed."""
        with self._lock:
            self._closed = True


def finish(steps: Generator[Wait, None, Result]) -> Result:
    """Run a generator to its end, blocking in each wait; returns its result."""
    try:
        while True:
            sockets, seconds = next(steps)
            poller = select.poll()
            for socket in sockets:
                poller.register(socket, select.POLLIN)
            poller.poll(seconds * 1000)
    except StopIteration as stop:
        return stop.value  # type: ignore[no-any-return]


async def finish_async(steps: Generator[Wait, None, Result]) -> Result:
    """The same, without blocking the event loop."""
    try:
        while True:
            await readable(*next(steps))
    except StopIteration as stop:
        return stop.value  # type: ignore[no-any-return]


async def readable(sockets: Sequence[int], seconds: float) -> None:
    """Return once something may have arrived at one of the sockets, or after so many seconds."""
    loop, arrived = asyncio.get_running_loop(), asyncio.Event()
    try:
        for socket in sockets:
            loop.add_reader(socket, arrived.set)
        async with asyncio.timeout(seconds):
            await arrived.wait()
    except OSError:  # the time is over, or another thread has closed a socket
        pass
    finally:
        for socket in sockets:
            loop.remove_reader(socket)
