"""Subscribers that wait for a pipeline announce themselves, so that the pipeline begins once they are connected.

An announcement is a file beside the private folders of this user's pipelines. It is locked as long as its subscriber
lives, and names the endpoint and the channels. The detector reads it before its first frame, and waits until the
subscriber has subscribed to its own topic (`Subscriber`, parameter `reader`) on each of the channels.
"""

from __future__ import annotations

import contextlib
import math
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Self

from catstream.messages.storage import lock
from catstream.wire.endpoint import Endpoint, homes, notes

__all__ = ["Announcement", "readers_of"]

_PREFIX = "catstream-reader-"


class Announcement:
    """Announces that a subscriber waits at an endpoint, until it is closed or its process ends.

    Parameters
    ----------
    endpoint : Endpoint
        Endpoint at which the subscriber waits.
    channels : iterable of str
        Names of the channels whose messages it receives from the first one on.

    Attributes
    ----------
    reader : str
        Name of the subscriber, for its `Subscriber` of each channel.
    """

    def __init__(self, endpoint: Endpoint, channels: Iterable[str]) -> None:
        self.reader = secrets.token_hex(8)
        self._file: IO[str] | None = None
        text = "\n".join([_place(endpoint), *channels])
        # If no folder can be written to, nothing is announced: the first messages are then missed, and counted.
        with contextlib.suppress(OSError, IndexError):
            path = homes()[0] / f"{_PREFIX}{self.reader}"
            hidden = path.with_name(f".{path.name}")
            self._file = hidden.open("x")
            lock(self._file.fileno(), math.inf)
            self._file.write(text)
            self._file.flush()
            self._path = hidden.rename(path)  # atomic: the file is never visible without its lock

    def close(self) -> None:
        """Withdraw the announcement."""
        if self._file is not None:
            self._path.unlink(missing_ok=True)
            self._file.close()
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def readers_of(endpoint: Endpoint) -> dict[str, set[str]]:
    """Names of this user's subscribers that wait at an endpoint, by channel; removes the files of dead ones."""
    readers: dict[str, set[str]] = {}
    for path, text in notes(set(homes()), f"{_PREFIX}*"):
        if text is None:
            path.unlink(missing_ok=True)
            continue
        place, *channels = text.split("\n")
        if place == _place(endpoint):
            for channel in channels:
                readers.setdefault(channel, set()).add(path.name.removeprefix(_PREFIX))
    return readers


def _place(endpoint: Endpoint) -> str:
    """A name of the endpoint that does not depend on how its folder was written."""
    return str(Path(endpoint.folder).resolve()) if endpoint.folder is not None else str(endpoint)
