"""Receives from many subscribers in one thread, at once or at intervals."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

from catstream.messages.kinds import End
from catstream.wire.newest import Subscriber

__all__ = ["arrivals", "rounds"]

_POLL_SECONDS = 0.1

Key = TypeVar("Key")
Message = TypeVar("Message")


def arrivals(
    readers: Mapping[Key, Subscriber[Message]], is_over: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Key, float, Message]]:
    """Yield (key of the subscriber, arrival time by `time.monotonic`, message) until `is_over` or all have ended."""
    poller, keys = select.poll(), {}
    for key, reader in readers.items():
        keys[reader.fileno()] = key
        poller.register(reader.fileno(), select.POLLIN)
    while keys and not is_over():
        for handle, _ in poller.poll(1000 * _POLL_SECONDS):
            key = keys[handle]
            while (message := readers[key].receive(0)) is not None:
                yield key, time.monotonic(), message
                if isinstance(message, End):
                    poller.unregister(handle)
                    del keys[handle]
                    break


def rounds(readers: Mapping[Key, Subscriber[Message]], pause: float, most: int) -> Iterator[tuple[Key, Message]]:
    """Yield (key of the subscriber, message): at most `most` messages of each, then a pause, until all have ended."""
    left = set(readers)
    while left:
        for key, reader in readers.items():
            for _ in range(most if key in left else 0):
                if (message := reader.receive(0)) is None:
                    break
                yield key, message
                if isinstance(message, End):
                    left.remove(key)
                    break
        time.sleep(pause)
