"""The store of a fleet, a folder or an S3 bucket: states of streams, the fleet's spec, and saved models.

    streams/NAME/          states of a stream
    models/NAME/OBJECT/    saved model with which an object of a stream begins
    fleet/                 desired streams of the fleet

In each of these folders, only the holder of the newest claim decides the next state:

    <token>/claim     the claim of a holder; its token is higher than every earlier token
    <token>/<n>       its states: n = 1, 2, 3 ...

    claim   create the claim of the highest token + 1. If another process has created it already, try the next token
    write   create the next state under the own token, then list the folder. If there is a claim with a higher token,
            this holder was superseded, and must stop
    read    read the newest undamaged state of the highest token with a state

A holder that was paused or disconnected may continue to write under its own token. Once the newer holder has written a
state, older ones are ignored. Before, they continue the state from which the newer holder began. If the answer to a
claim or a write is lost, the caller uses the next token or number; incomplete states are skipped.

A holder removes all states except the newest two, and older claims without a state. A removed stream keeps one state,
which hides late writes of an earlier holder (docs/decisions.md, 78).

A state contains the source of its stream, which may contain a password. Therefore the folders and the bucket must be
private. obstore reads the credentials of S3 from the environment or the machine's role, and the address of another
server from AWS_ENDPOINT_URL. They are not part of the URL, which is shown in messages.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from catstream.base.names import UNNAMED, check_name
from catstream.errors import FencedError, FleetError, ProtocolError, StoreError, require_fleet
from catstream.fleet.spec import check_fleet_name
from catstream.wire import storage

STORE_SECONDS = 10.0  # timeout of a request to a server
CONNECT_SECONDS = 3.0  # timeout for a connection to a server

_FOLDERS = ("streams", "models", "fleet")
_CLAIM = "claim"
_DIGITS = 8  # of a token and of a state's number in names
_KEEP = 2  # number of newest states that are not removed
_ATTEMPTS = 20  # to claim or read while other processes change the folder
_NO_NAME = "-"  # folder of the object without a name; names do not begin with a dash
_PROBE = "created-exclusively"
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_CODE = re.compile(r"<Code>(\w{1,64})</Code>")  # in a response of S3
_NUMBER = re.compile(r"\(os error ([0-9]+)\)")  # in an error of obstore
_ROLE = "/latest/"  # in the address of the metadata service, which provides the credentials of a role


class Store:
    """The store of a fleet: immutable objects below a folder or a prefix of a bucket, created exclusively.

    The URL is a folder or s3://bucket/prefix; FleetError if it is invalid or contains credentials.
    Every method raises StoreError if the store cannot be reached or is full; an object may have been created
    nevertheless. Messages contain no credentials.
    """

    def __init__(self, url: str) -> None:
        self._url, self._folder = _parse(url)
        require_fleet()

    @property
    def fleet(self) -> StateStore:
        """The desired states of the fleet, each as the file `fleet`."""
        return StateStore(self, "fleet")

    def stream(self, name: str) -> StateStore:
        check_fleet_name(name, "stream")
        return StateStore(self, f"streams/{name}")

    def model(self, stream: str, name: str) -> StateStore:
        """The saved models of an object of a stream, each as the file `model`."""
        return StateStore(self, f"models/{stream}/{_NO_NAME if name == UNNAMED else check_name(name)}")

    def check(self) -> None:
        """Create the folders of the store; StoreError if it is unusable.

        A bucket must exist, on a server that supports exclusive creation.
        """
        if self._folder is not None:
            with self._errors("", "created"):
                for folder in (self._folder, *map(self._folder.joinpath, _FOLDERS)):
                    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            return
        try:
            for _ in range(2):
                self.create(_PROBE, b"")
        except FileExistsError:
            return
        raise StoreError(
            f"the server of the store {self._url} ignores If-None-Match, so two processes could write the state of one "
            "stream: use a server that supports it, such as AWS S3 or a current MinIO"
        )

    def create(self, name: str, data: bytes) -> None:
        """Create an object; FileExistsError if it exists already."""
        from obstore.exceptions import AlreadyExistsError

        with self._errors(name, "written"):
            try:
                self._store.put(name, data, mode="create")
            except AlreadyExistsError:  # or another process is creating it
                raise FileExistsError(name) from None

    def read(self, name: str) -> bytes:
        """Return the content of an object; FileNotFoundError if it does not exist."""
        with self._errors(name, "read"):
            return bytes(self._store.get(name).bytes())

    def names(self, folder: str) -> list[str]:
        """Return the names of all objects below a folder, relative to it."""
        with self._errors(folder, "listed"):
            return [entry["path"][len(folder) + 1 :] for entry in self._store.list(folder).collect()]

    def remove(self, name: str) -> None:
        """Remove an object, if it exists, and incomplete files of killed processes next to it."""
        with contextlib.suppress(FileNotFoundError), self._errors(name, "removed"):
            if self._folder is not None:
                for part in (self._folder / name).parent.glob("*#*"):  # obstore's names of incomplete files
                    part.unlink()
            self._store.delete(name)

    @cached_property
    def _store(self) -> Any:
        """The client of the folder or bucket. Requests are not retried: the caller writes a newer state later."""
        from obstore.store import LocalStore, from_url

        if self._folder is not None:
            if not self._folder.is_dir():
                raise StoreError(f"the store {self._url} is not a folder on this machine: is its file system mounted?")
            return LocalStore(self._folder, automatic_cleanup=True)
        limits: Any = {"timeout": timedelta(seconds=STORE_SECONDS)}
        limits |= {"connect_timeout": timedelta(seconds=CONNECT_SECONDS)}
        return from_url(
            self._url,
            client_options=limits | {"allow_http": True},  # for addresses that begin with http
            retry_config={"max_retries": 0},
            disable_bulk_delete=True,  # not supported by all servers
        )

    @contextlib.contextmanager
    def _errors(self, name: str, what: str) -> Iterator[None]:
        """Convert every error in the block to a StoreError, except that an object exists or does not exist."""
        try:
            yield
        except StoreError:
            raise
        except Exception as error:
            is_about_one = isinstance(error, FileNotFoundError | FileExistsError) and what != "created"
            if is_about_one and "NoSuchBucket" not in str(error):
                raise type(error)(name) from None
            subject = f"{name} of the store" if name else "the store"
            raise StoreError(f"{subject} {self._url} cannot be {what}: {_trouble(error)}") from None


def _parse(url: str) -> tuple[str, Path | None]:
    """The URL for messages, and its folder. Errors do not contain the URL, which may contain a password."""
    parts = urlsplit(url)
    if "://" not in url:
        return str(Path(url).resolve()), Path(url).resolve()
    if parts.username is not None or parts.password is not None or parts.query or parts.fragment:
        raise FleetError(
            "the URL of the store contains a user, a password or a query: pass s3://bucket/prefix, and credentials in "
            "the environment"
        )
    if parts.scheme == "s3" and _BUCKET.fullmatch(parts.netloc):
        return f"s3://{parts.netloc}/{parts.path.strip('/')}".rstrip("/"), None
    raise FleetError("the URL of the store is not valid: expected a folder or s3://bucket/prefix")


def _trouble(error: Exception) -> str:
    """Describe an error and its remedy, without the original text, which may contain credentials."""
    text = str(error)
    if code := _CODE.search(text):
        return f"the server answered {code[1]}: check the bucket, its region (AWS_REGION) and its permissions"
    if _ROLE in text:
        return "no credentials were found: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    if "kind: Timeout" in text:
        return f"no answer within {STORE_SECONDS:g} s: check the network and the server"
    number = error.errno if isinstance(error, OSError) else int(match[1]) if (match := _NUMBER.search(text)) else None
    if number is None:
        return f"{type(error).__name__}: check the network, the server and AWS_REGION"
    is_full = number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return f"{os.strerror(number)}: {'free some space there' if is_full else 'check the folder, or the server'}"


class Contents(NamedTuple):
    """The listing of the folder of a stream.

    claims  tokens of the claims
    states  token of the writer and number of each state
    """

    claims: set[int]
    states: set[tuple[int, int]]

    @classmethod
    def of(cls, names: Iterable[str]) -> Contents:
        """Parse names relative to the folder; unknown names are ignored.

        >>> Contents.of(["00000001/claim", "00000001/00000007", "00000001/.part"])
        Contents(claims={1}, states={(1, 7)})
        """
        parts = [name.split("/") for name in names]
        claims = {int(token) for token, *rest in parts if token.isdecimal() and rest == [_CLAIM]}
        numbers = [part for part in parts if len(part) == 2 and all(text.isdecimal() for text in part)]
        return cls(claims, {(int(token), int(number)) for token, number in numbers})


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A state of a stream in the store.

    token   token of the holder that wrote it
    files   contents by name
    facts   JSON: frame, time and other facts by the writer
    """

    token: int
    files: dict[str, bytes] = field(repr=False)
    facts: dict[str, Any]


class StateStore:
    """The states in a folder of the store. Every method may be repeated, and raises StoreError if the store fails."""

    def __init__(self, objects: Store, folder: str) -> None:
        self._objects = objects
        self.folder = folder

    def newest(self) -> Snapshot | None:
        """Return the newest undamaged state of the highest token with a state, or None."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FileNotFoundError):  # the holder has removed it after the listing
                state = next(filter(None, map(self._read, sorted(self.listed().states, reverse=True))), None)
                return None if state is None or state.facts.get("removed") else state
        raise self._busy("read")

    def claim(self) -> Claim:
        """Claim the exclusive right to write states."""
        for _ in range(_ATTEMPTS):
            listing = self.listed()
            token = max([0, *listing.claims, *(token for token, _ in listing.states)]) + 1
            with contextlib.suppress(FileExistsError):  # another process has just claimed this token
                self._objects.create(self._name(token, _CLAIM), b"")
                return Claim(self, token, self.newest())
        raise self._busy("claimed")

    def put(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Claim, and write a single state. Concurrent calls write one after the other."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FencedError):
                return self.claim().write(files, facts)
        raise self._busy("written")

    def clear(self) -> None:
        """Remove all states, and supersede the holder, which can no longer write."""
        if self.newest() is not None:
            claim = self.claim()
            claim.write({}, {"removed": True})
            self.remove_up_to(claim.token, self.listed(), keep=1)

    def listed(self) -> Contents:
        """List the folder."""
        return Contents.of(self._objects.names(self.folder))

    def create(self, token: int, number: int, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        arrays = {name: np.frombuffer(content, np.uint8) for name, content in files.items()}
        self._objects.create(self._name(token, number), storage.encode(arrays, {"facts": dict(facts)}))

    def remove_up_to(self, token: int, listing: Contents, keep: int) -> None:
        """Remove the states up to a token except the newest `keep`, and lower claims without a remaining state."""
        states = sorted(version for version in listing.states if version[0] <= token)
        remaining = states[len(states) - keep :]
        for version in states[: len(states) - keep]:
            self._objects.remove(self._name(*version))
        for old in sorted(listing.claims - {writer for writer, _ in remaining}):
            if old < token:
                self._objects.remove(self._name(old, _CLAIM))

    def _name(self, token: int, rest: str | int) -> str:
        return f"{self.folder}/{token:0{_DIGITS}}/{rest if isinstance(rest, str) else f'{rest:0{_DIGITS}}'}"

    def _read(self, version: tuple[int, int]) -> Snapshot | None:
        """Read a state; None if it is damaged."""
        name = self._name(*version)
        try:
            arrays, header = storage.decode(self._objects.read(name), name)
            files = {key: array.tobytes() for key, array in arrays.items()}
            return Snapshot(version[0], files, dict(header["facts"]))
        except (ProtocolError, KeyError, TypeError, ValueError):
            return None

    def _busy(self, what: str) -> StoreError:
        return StoreError(f"{self.folder} could not be {what} (other processes keep changing it): try again later")


class Claim:
    """The exclusive right to write the states of a stream, until another process claims it.

    token    fencing token, higher than all earlier tokens
    state    state from which to continue, or None
    """

    def __init__(self, states: StateStore, token: int, state: Snapshot | None) -> None:
        self.token, self.state, self._states = token, state, states
        self._number = 0
        self._fenced: FencedError | None = None

    def write(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Write a state, and remove older ones.

        Raises FencedError, now and in all later calls, if another process has claimed the stream. Raises StoreError if
        the store fails; the caller may continue, and write a newer state later.
        """
        if self._fenced is not None:
            raise self._fenced
        self._number += 1  # not reused, even if this fails
        with contextlib.suppress(FileExistsError):  # the answer was lost, and the request was repeated
            self._states.create(self.token, self._number, files, facts)
        listing = self.check()
        with contextlib.suppress(StoreError):  # the next write retries
            self._states.remove_up_to(self.token, listing, _KEEP)

    def check(self) -> Contents:
        """Return the listing of the folder; FencedError if there is a higher token, or this claim was removed."""
        listing = self._states.listed()
        if self.token in listing.claims and max(listing.claims) == self.token:
            return listing
        self._fenced = FencedError(
            f"{self._states.folder} was claimed by another process (token {max(listing.claims, default=0)}) after this "
            f"one (token {self.token}), which has to stop"
        )
        raise self._fenced
