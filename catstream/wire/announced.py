"""Subscribers that wait for a pipeline announce it, so that the pipeline begins once they are connected.

An announcement is a file beside the private folders of this user's pipelines, locked for as long as its subscriber
lives. It says at which endpoint the subscriber waits, and for which channels. The detector reads it before its first
frame, and waits until the subscriber's own topic (`Subscriber`, parameter `reader`) has come in at each of them.
"""

from __future__ import annotations

import contextlib
import math
import os
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Self

from catstream.storage import is_locked, lock
from catstream.wire.endpoint import Endpoint, homes

__all__ = ["Announcement", "readers_of"]

_PREFIX = "catstream-reader-"


class Announcement:
    """Says that a subscriber waits at an endpoint; until it is closed, or its process is gone.

    Parameters
    ----------
    endpoint : Endpoint
        Where it waits.
    channels : iterable of str
        Names of the channels of which it wants every message.

    Attributes
    ----------
    reader : str
        Name of the subscriber, to be given to its `Subscriber` of each of these channels.
    """

    def __init__(self, endpoint: Endpoint, channels: Iterable[str]) -> None:
        self.reader = secrets.token_hex(8)
        self._file: IO[str] | None = None
        text = "\n".join([_place(endpoint), *channels])
        # Without a folder to write to nothing is announced: messages are then missed, and counted.
        with contextlib.suppress(OSError, IndexError):
            path = homes()[0] / f"{_PREFIX}{self.reader}"
            hidden = path.with_name(f".{path.name}")
            self._file = hidden.open("x")
            lock(self._file.fileno(), math.inf)
            self._file.write(text)
            self._file.flush()
            self._path = hidden.rename(path)  # never there without its lock

    def close(self) -> None:
        """Take it back."""
        if self._file is not None:
            self._path.unlink(missing_ok=True)
            self._file.close()
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def readers_of(endpoint: Endpoint) -> dict[str, set[str]]:
    """Names of this user's subscribers that wait at an endpoint, by channel; the files of dead ones are removed."""
    readers: dict[str, set[str]] = {}
    for home in set(homes()):
        for path in home.glob(f"{_PREFIX}*"):
            with contextlib.suppress(OSError), path.open() as file:  # it may be gone by now, or another user's
                if os.fstat(file.fileno()).st_uid != os.geteuid():
                    continue
                if not is_locked(file.fileno()):
                    path.unlink()
                    continue
                place, *channels = file.read().split("\n")
                if place == _place(endpoint):
                    for channel in channels:
                        readers.setdefault(channel, set()).add(path.name.removeprefix(_PREFIX))
    return readers


def _place(endpoint: Endpoint) -> str:
    """The same for all that name this endpoint in their own way."""
    return str(Path(endpoint.folder).resolve()) if endpoint.folder is not None else str(endpoint)
