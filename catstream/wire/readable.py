"""Waits for sockets, in programs with and without an event loop.

What has to wait is written once, as a generator: it yields each `Wait`, and returns its result. `finish` runs it and
blocks in each wait, `finish_async` runs it in an asyncio event loop.
"""

from __future__ import annotations

import asyncio
import select
from collections.abc import Generator, Sequence
from typing import NamedTuple, Protocol, TypeVar

__all__ = ["Wait", "finish", "finish_async", "readable"]

Result = TypeVar("Result")


class _HasFileno(Protocol):
    def fileno(self) -> int: ...


class Wait(NamedTuple):
    """A wait until something may have arrived at one of the sockets, or for so many seconds."""

    sockets: Sequence[_HasFileno]
    seconds: float


def finish(steps: Generator[Wait, None, Result]) -> Result:
    """Run a generator to its end, blocking in each wait; returns its result."""
    try:
        while True:
            sockets, seconds = next(steps)
            poller = select.poll()
            for socket in sockets:
                poller.register(socket.fileno(), select.POLLIN)
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


async def readable(sockets: Sequence[_HasFileno], seconds: float) -> None:
    """Return once something may have arrived at one of the sockets, or after so many seconds."""
    loop, arrived = asyncio.get_running_loop(), asyncio.Event()
    handles = [socket.fileno() for socket in sockets]
    for handle in handles:
        loop.add_reader(handle, arrived.set)
    try:
        async with asyncio.timeout(seconds):
            await arrived.wait()
    except TimeoutError:
        pass
    finally:
        for handle in handles:
            loop.remove_reader(handle)
