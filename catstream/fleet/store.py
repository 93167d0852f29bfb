"""The store of a fleet: states of streams, the fleet's spec and merged models, in a folder or an S3 bucket.

    streams/NAME/    states of a stream
    models/OBJECT/   merged models of an object
    fleet/           specs of the fleet

Of each, the newest two are kept, as `catstream.fleet.states` describes. A state contains the source of its stream,
which may contain a password: files are readable by their owner only, and a bucket has to be private.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Mapping
from typing import Any

from catstream.errors import FencedError, FleetError
from catstream.fleet.objects import FsspecObjects
from catstream.fleet.states import Claim, Generation, Listing, States
from catstream.messages.names import UNNAMED, check_name

__all__ = ["Claim", "Generation", "Store"]

_STREAM = re.compile(r"(?!\.+$)[A-Za-z0-9._-]{1,64}")
_NO_NAME = "-"  # folder of the object without a name: no name begins with a dash
_ATTEMPTS = 5


class Store:
    """The store of a fleet.

    Parameters
    ----------
    url : folder, file:///folder or s3://bucket/prefix; the folder has to exist, or is made by `check`

    Raises
    ------
    FleetError
        If the URL is not valid, or contains credentials.
    MissingExtraError
        If a package is not installed that it needs.
    """

    def __init__(self, url: str) -> None:
        self._objects = FsspecObjects(url)
        self._checked = False

    def __repr__(self) -> str:
        return repr(self._objects).replace("FsspecObjects", "Store")

    def check(self) -> None:
        """Check that the store can be used; a folder is created, if it does not exist.

        Raises
        ------
        StoreError
            If it cannot.
        """
        self._objects.make()
        self._objects.check()
        self._checked = True

    def claim(self, stream: str, holder: str) -> Claim:
        """Become the only process that may write the states of a stream.

        Parameters
        ----------
        holder : name of the process for messages, such as its node

        Raises
        ------
        StoreError
            If the store cannot be reached or is full. The call may be repeated.
        """
        return self._writable(_streams(stream)).claim(holder)

    def newest(self, stream: str) -> Generation | None:
        """Return the newest state of a stream; None if there is none."""
        return self._states(_streams(stream)).newest()

    def streams(self) -> list[str]:
        """Return the names of all streams that have a state."""
        names: dict[str, list[str]] = {}
        for name in self._objects.names("streams"):
            stream, _, rest = name.partition("/")
            names.setdefault(stream, []).append(rest)
        return sorted(stream for stream, below in names.items() if Listing.of(below).newest())

    def remove(self, stream: str) -> None:
        """Remove the states of a stream. A process that still holds it can write no more."""
        self._states(_streams(stream)).clear(_this_process())

    def put_fleet(self, text: str) -> None:
        """Store the spec of the fleet."""
        self._put("fleet", {"fleet": text.encode()}, {})

    def get_fleet(self) -> str | None:
        """Return the newest spec of the fleet; None if there is none."""
        found = self._states("fleet").newest()
        return found.files["fleet"].decode() if found else None

    def put_model(self, name: str, data: bytes, facts: Mapping[str, Any]) -> None:
        """Store the merged model of an object.

        Parameters
        ----------
        name : the name of the object
        """
        self._put(_models(name), {"model": data}, facts)

    def get_model(self, name: str, after: int = 0) -> Generation | None:
        """Return the newest merged model of an object, as the file `model`.

        Parameters
        ----------
        name : the name of the object
        after : token of the model that the caller has; None is returned if there is no newer one, which is quick
        """
        return self._states(_models(name)).newest(after)

    def _put(self, folder: str, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Write where there is no lasting holder. Of two processes at once, both write, one after the other."""
        for attempt in range(_ATTEMPTS):
            try:
                self._writable(folder).claim(_this_process()).write(files, facts)
                return
            except FencedError:
                if attempt == _ATTEMPTS - 1:
                    raise

    def _states(self, folder: str) -> States:
        return States(self._objects, folder)

    def _writable(self, folder: str) -> States:
        """The states of a folder, in a store that was checked."""
        if not self._checked:
            self._objects.check()
            self._checked = True
        return self._states(folder)


def _streams(name: str) -> str:
    if not _STREAM.fullmatch(name):
        raise FleetError(
            f"{name[:80]!r} is not the name of a stream: expected 1 to 64 letters, digits, dots, dashes and underscores"
        )
    return f"streams/{name}"


def _models(name: str) -> str:
    return f"models/{_NO_NAME if name == UNNAMED else check_name(name)}"


def _this_process() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}"
