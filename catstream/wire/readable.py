"""Waits for sockets in an asyncio event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Protocol

__all__ = ["readable"]


class _HasFileno(Protocol):
    def fileno(self) -> int: ...


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
