"""The store of a fleet, a folder or an S3 bucket: states of streams, the fleet's spec, and merged models.

    streams/NAME/    states of a stream
    models/OBJECT/   merged models of an object
    fleet/           desired streams of the fleet

Below each of these folders, only the newest holder decides what comes next:

    <token>/claim     the claim of a holder; the token is one higher than that of every earlier claim
    <token>/<n>       its states, every few seconds: n = 1, 2, 3 ...
    <token>/removed   the stream was removed by the holder: nobody reads the states of lower tokens any more

    claim   create the claim of the highest token + 1; this fails if another process has it already: try the next one
    write   create the next state under the own token, then list the folder: if there is a claim with a higher token,
            this holder was superseded, and has to stop
    read    take the newest undamaged state of the highest token that has one

A holder that was paused or cut off may continue to write under its own token: as soon as the newer holder has written
one state, nobody reads the older ones any more. Before that, its states continue the one that the newer holder began
from, and are as good as any. What can fail besides:

    the answer to a claim is lost   The caller claims again, and gets the next token; a claim without states is passed.
    the answer to a write is lost   The caller writes the next state, under the next number.
    a write ends half way           The state is damaged, and is passed over.

A holder removes all states but the newest two, and the older claims that have no state any more. Of a stream that was
removed, a claim stays, so that a holder that comes back later finds that it was superseded. See
docs/decisions/0078-fencing-by-name.md.

A state contains the source of its stream, which may contain a password: files are readable by their owner only, and a
bucket has to be private.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from catstream.errors import FencedError, ProtocolError, StoreError
from catstream.fleet.objects import Objects
from catstream.fleet.spec import check_fleet_name
from catstream.messages import storage
from catstream.messages.names import UNNAMED, check_name

_CLAIM, _REMOVED = "claim", "removed"
_DIGITS = 8  # of a token and of the number of a state in their names
_KEPT = 2  # newest states
_ATTEMPTS = 20  # to claim, or to read the newest state, while other processes change the folder
_LONGEST_HOLDER = 200
_NO_NAME = "-"  # folder of the object without a name: no name begins with a dash


class _Place(NamedTuple):
    """The place of a state: the token of its writer, and its number."""

    token: int
    number: int


@dataclass(frozen=True, slots=True)
class Listing:
    """What is below the folder of a stream.

    claims   tokens of the claims
    states   places of the states
    removed  highest token under which the stream was removed; 0 if it never was
    """

    claims: set[int]
    states: set[_Place]
    removed: int

    @classmethod
    def of(cls, names: Iterable[str]) -> Listing:
        """The listing of these names, each without the folder; names of other things are passed over.

        >>> Listing.of(["00000001/claim", "00000001/00000007", "00000001/.part"])
        Listing(claims={1}, states={_Place(token=1, number=7)}, removed=0)
        """
        claims, states, removed = set[int](), set[_Place](), 0
        for name in names:
            token, _, rest = name.partition("/")
            if token.isdecimal() and rest.isdecimal():
                states.add(_Place(int(token), int(rest)))
            elif token.isdecimal() and rest == _CLAIM:
                claims.add(int(token))
            elif token.isdecimal() and rest == _REMOVED:
                removed = max(removed, int(token))
        return cls(claims, states, removed)

    def newest(self, after: int = 0) -> list[_Place]:
        """The places of the states that may be read, those of holders with a token above `after`, newest first."""
        return sorted((place for place in self.states if place.token > max(after, self.removed)), reverse=True)


@dataclass(frozen=True, slots=True)
class Generation:
    """A state of a stream in the store.

    token   of the holder that wrote it
    files   contents by name
    facts   JSON: frame, time and whatever else the writer added
    """

    token: int
    files: dict[str, bytes] = field(repr=False)
    facts: dict[str, Any]


class States:
    """The states below a folder of the store.

    Every method raises StoreError if the store cannot be reached or is full; the call may be repeated.
    """

    def __init__(self, objects: Objects, folder: str) -> None:
        self._objects = objects
        self.folder = folder

    def newest(self, after: int = 0) -> Generation | None:
        """Return the newest state of a holder with a token above `after`. If there is none, no state is read."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FileNotFoundError):  # removed by the holder since the folder was listed
                states = (self._read(place) for place in self.listed().newest(after))
                return next((state for state in states if state is not None), None)
        raise self._busy("read")

    def claim(self, holder: str) -> Claim:
        """Become the only process that may write states; the name of the holder, such as its node, is for messages."""
        for _ in range(_ATTEMPTS):
            found = self.listed()
            token = max([0, *found.claims, *(place.token for place in found.states)]) + 1
            with contextlib.suppress(FileExistsError):  # another process claims at this moment
                self._objects.create(self._name(token, _CLAIM), holder[:_LONGEST_HOLDER].encode())
                with contextlib.suppress(StoreError):  # the next claim does it
                    self._objects.tidy(self.folder)
                return Claim(self, token, holder, self.newest(), found.removed)
        raise self._busy("claimed")

    def put(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Write a state where there is no lasting holder. Of two processes at once, both write, one after the other."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FencedError):
                return self.claim(_this_process()).write(files, facts)
        raise self._busy("written")

    def clear(self) -> None:
        """Remove all states. A process that still holds them is superseded: it can no longer write."""
        if self.listed().newest():
            token = self.claim(_this_process()).token
            with contextlib.suppress(FileExistsError):
                self._objects.create(self._name(token, _REMOVED), b"")
            self.remove_up_to(token, self.listed(), kept=0)

    def listed(self) -> Listing:
        """What is below the folder now."""
        return Listing.of(self._objects.names(self.folder))

    def holder(self, token: int) -> str:
        """The name of the holder with a token, for messages."""
        with contextlib.suppress(FileNotFoundError, StoreError, UnicodeDecodeError):
            return self._objects.read(self._name(token, _CLAIM)).decode()
        return "another process"

    def create(self, place: _Place, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Create a state."""
        arrays = {name: np.frombuffer(content, np.uint8) for name, content in files.items()}
        self._objects.create(self._name(*place), storage.encode(arrays, {"facts": dict(facts)}))

    def remove_up_to(self, token: int, found: Listing, kept: int) -> None:
        """Remove the states up to a token but the newest ones, and the claims below it that have none any more.

        Parameters
        ----------
        found : what is below the folder
        """
        before = sorted(place for place in found.states if place.token <= token)
        stay = before[len(before) - kept :]
        for place in before[: len(before) - kept]:
            self._objects.remove(self._name(*place))
        for old in sorted(found.claims - {place.token for place in stay}):
            if old < token:
                for rest in (_REMOVED, _CLAIM):
                    self._objects.remove(self._name(old, rest))

    def _name(self, token: int, rest: str | int) -> str:
        return f"{self.folder}/{token:0{_DIGITS}}/{rest if isinstance(rest, str) else f'{rest:0{_DIGITS}}'}"

    def _read(self, place: _Place) -> Generation | None:
        """A state; None if it is damaged."""
        name = self._name(*place)
        try:
            arrays, header = storage.decode(self._objects.read(name), name)
            return Generation(place.token, {key: each.tobytes() for key, each in arrays.items()}, dict(header["facts"]))
        except (ProtocolError, KeyError, TypeError, ValueError):
            return None

    def _busy(self, what: str) -> StoreError:
        return StoreError(f"{self.folder} could not be {what}: other processes change it all the time; try again later")


class Claim:
    """The right to write the states of a stream, until another process claims it.

    token    higher than that of every earlier claim
    state    the state to continue from; None if there is none
    removed  token under which the stream was removed last; 0 if it never was
    """

    def __init__(self, states: States, token: int, holder: str, state: Generation | None, removed: int) -> None:
        self.token, self.state, self.removed = token, state, removed
        self._states, self._holder = states, holder
        self._number = 0
        self._fenced: FencedError | None = None

    def __repr__(self) -> str:
        return f"Claim({self._states.folder!r}, token={self.token})"

    def write(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Write a state, and remove states that are no longer needed.

        Parameters
        ----------
        files : contents by name
        facts : JSON about the state: frame, time ...

        Raises
        ------
        FencedError
            If another process has claimed the stream. Every later call raises it too.
        StoreError
            If the store cannot be reached or is full. The caller continues, and writes a newer state later.
        """
        if self._fenced is not None:
            raise self._fenced
        self._number += 1  # whatever becomes of this state, its number is not used again
        with contextlib.suppress(FileExistsError):  # the answer was lost, and the request sent again
            self._states.create(_Place(self.token, self._number), files, facts)
        found = self._states.listed()
        self._check(found.claims)
        with contextlib.suppress(StoreError):  # they are removed after the next write
            self._states.remove_up_to(self.token, found, _KEPT)

    def _check(self, claims: set[int]) -> None:
        """Raise FencedError if there is a claim with a higher token, or this one was removed."""
        if self.token in claims and max(claims) == self.token:
            return
        newer = self._states.holder(max(claims, default=0))
        self._fenced = FencedError(
            f"{self._states.folder} was claimed by {newer} after {self._holder} (token {self.token}): "
            f"{self._holder} may not write it any more, and has to stop"
        )
        raise self._fenced


class Store:
    """The store of a fleet: the states of its streams, its desired state, and its merged models.

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
        self._objects = Objects(url)

    def __repr__(self) -> str:
        return repr(self._objects).replace("Objects", "Store")

    def check(self) -> None:
        """Check that the store can be used; a folder is created, if it does not exist.

        Raises
        ------
        StoreError
            If it cannot.
        """
        self._objects.make()

    @property
    def fleet(self) -> States:
        """The desired states of the fleet, each as the file `fleet`."""
        return States(self._objects, "fleet")

    def stream(self, name: str) -> States:
        """The states of a stream."""
        check_fleet_name(name, "stream")
        return States(self._objects, f"streams/{name}")

    def model(self, name: str) -> States:
        """The merged models of an object, each as the file `model`."""
        return States(self._objects, f"models/{_NO_NAME if name == UNNAMED else check_name(name)}")


def _this_process() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}"
