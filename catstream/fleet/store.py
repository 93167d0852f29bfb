"""The store of a fleet, a folder or an S3 bucket: states of streams, the fleet's spec, and saved models.

    streams/NAME/          states of a stream
    models/NAME/OBJECT/    saved model with which an object of a stream begins
    fleet/                 desired streams of the fleet

Below each of these folders, only the newest holder decides what comes next:

    <token>/claim     the claim of a holder; its token is higher than every earlier token
    <token>/<n>       its states: n = 1, 2, 3 ...

    claim   create the claim of the highest token + 1; this fails if another process has it already: try the next one
    write   create the next state under the own token, then list the folder: if there is a claim with a higher token,
            this holder was superseded, and has to stop
    read    take the newest undamaged state of the highest token that has one

A holder that was paused or disconnected may continue to write under its own token: as soon as the newer holder has
written a state, older ones are not read. Before that, they continue the state that the newer holder began from. If the
answer to a claim or a write is lost, the caller uses the next token or number; a half-written state is passed over.

A holder removes all states but the newest two, and the older claims without a state. A removed stream keeps one state,
which hides late writes of an earlier holder (docs/decisions.md, 78).

A state contains the source of its stream, which may contain a password: only its owner may enter the folders, and a
bucket has to be private. obstore takes the credentials of S3 from the environment or the machine's role, and the
address of another server from AWS_ENDPOINT_URL. They are not part of the URL, which is shown in messages.
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

STORE_SECONDS = 10.0  # limit of a request to a server
CONNECT_SECONDS = 3.0  # limit to connect to a server

_FOLDERS = ("streams", "models", "fleet")
_CLAIM = "claim"
_DIGITS = 8  # of a token and of the number of a state in their names
_KEEP = 2  # newest states
_ATTEMPTS = 20  # to claim, or to read the newest state, while other processes change the folder
_NO_NAME = "-"  # folder of the object without a name: no name begins with a dash
_PROBE = "created-exclusively"
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_CODE = re.compile(r"<Code>(\w{1,64})</Code>")  # in an answer of S3
_NUMBER = re.compile(r"\(os error ([0-9]+)\)")  # in an error of obstore
_ROLE = "/latest/"  # in the address at which a machine asks for the credentials of its role


class Store:
    """The store of a fleet: objects below a folder or a prefix of a bucket, created exclusively and never changed.

    The URL is a folder or s3://bucket/prefix; FleetError if it is not valid, or contains credentials.
    Every method raises StoreError if the store cannot be reached or is full; a call that creates an object may
    nevertheless have created it. No message contains a credential.
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
        """Create the folders of the store; StoreError if it cannot be used.

        A bucket has to exist, on a server that creates exclusively.
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
            f"the store {self._url} is on a server that ignores If-None-Match, so that two processes could write the "
            "state of one stream: use a server that supports it, such as AWS S3 or a current MinIO"
        )

    def create(self, name: str, data: bytes) -> None:
        """Create an object; FileExistsError if there is one of this name."""
        from obstore.exceptions import AlreadyExistsError

        with self._errors(name, "written"):
            try:
                self._store.put(name, data, mode="create")
            except AlreadyExistsError:  # also: another process creates it at this moment
                raise FileExistsError(name) from None

    def read(self, name: str) -> bytes:
        """Return the content of an object; FileNotFoundError if there is none."""
        with self._errors(name, "read"):
            return bytes(self._store.get(name).bytes())

    def names(self, folder: str) -> list[str]:
        """Return the names of all objects below a folder, without the name of the folder."""
        with self._errors(folder, "listed"):
            return [entry["path"][len(folder) + 1 :] for entry in self._store.list(folder).collect()]

    def remove(self, name: str) -> None:
        """Remove an object, if it exists, and beside it in a folder the parts that killed processes left."""
        with contextlib.suppress(FileNotFoundError), self._errors(name, "removed"):
            if self._folder is not None:
                for part in (self._folder / name).parent.glob("*#*"):  # as obstore names what it writes
                    part.unlink()
            self._store.delete(name)

    @cached_property
    def _store(self) -> Any:
        """The folder, or the bucket, to which requests are sent once: the caller writes a newer state later."""
        from obstore.store import LocalStore, from_url

        if self._folder is not None:
            if not self._folder.is_dir():
                raise StoreError(f"the store {self._url} is not a folder on this machine: is its file system mounted?")
            return LocalStore(self._folder, automatic_cleanup=True)
        limits: Any = {"timeout": timedelta(seconds=STORE_SECONDS)}
        limits |= {"connect_timeout": timedelta(seconds=CONNECT_SECONDS)}
        return from_url(
            self._url,
            client_options=limits | {"allow_http": True},  # at an address that begins with http
            retry_config={"max_retries": 0},
            disable_bulk_delete=True,  # one object each time, and not all servers have it
        )

    @contextlib.contextmanager
    def _errors(self, name: str, what: str) -> Iterator[None]:
        """In the block, every error becomes a StoreError, except that an object exists, or does not exist."""
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
    """A URL as it is shown, and its folder. No error shows the URL: it may contain a password."""
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
    """Describe an error and its remedy without the text of the error, which may contain a credential."""
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
    """The names below the folder of a stream.

    claims  tokens of the claims
    states  of each state, the token of its writer and its number
    """

    claims: set[int]
    states: set[tuple[int, int]]

    @classmethod
    def of(cls, names: Iterable[str]) -> Contents:
        """The listing of these names, each without the folder; other names are passed over.

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

    token   of the holder that wrote it
    files   contents by name
    facts   JSON: frame, time and other facts of the writer
    """

    token: int
    files: dict[str, bytes] = field(repr=False)
    facts: dict[str, Any]


class StateStore:
    """The states below a folder of the store. Every method raises StoreError if the store fails; it may be repeated."""

    def __init__(self, objects: Store, folder: str) -> None:
        self._objects = objects
        self.folder = folder

    def newest(self) -> Snapshot | None:
        """Return the newest undamaged state of the highest token that has one."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FileNotFoundError):  # removed by the holder since the folder was listed
                state = next(filter(None, map(self._read, sorted(self.listed().states, reverse=True))), None)
                return None if state is None or state.facts.get("removed") else state
        raise self._busy("read")

    def claim(self) -> Claim:
        """Become the only process that may write states."""
        for _ in range(_ATTEMPTS):
            listing = self.listed()
            token = max([0, *listing.claims, *(token for token, _ in listing.states)]) + 1
            with contextlib.suppress(FileExistsError):  # another process claims at this moment
                self._objects.create(self._name(token, _CLAIM), b"")
                return Claim(self, token, self.newest())
        raise self._busy("claimed")

    def put(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Write a state where there is no lasting holder. Of two processes at once, both write, one after the other."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FencedError):
                return self.claim().write(files, facts)
        raise self._busy("written")

    def clear(self) -> None:
        """Remove all states. A process that still holds them is superseded: it can no longer write."""
        if self.newest() is not None:
            claim = self.claim()
            claim.write({}, {"removed": True})
            self.remove_up_to(claim.token, self.listed(), keep=1)

    def listed(self) -> Contents:
        """The names below the folder now."""
        return Contents.of(self._objects.names(self.folder))

    def create(self, token: int, number: int, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        arrays = {name: np.frombuffer(content, np.uint8) for name, content in files.items()}
        self._objects.create(self._name(token, number), storage.encode(arrays, {"facts": dict(facts)}))

    def remove_up_to(self, token: int, listing: Contents, keep: int) -> None:
        """Remove the states up to a token but the newest ones, and the claims below it that have none any more."""
        before = sorted(version for version in listing.states if version[0] <= token)
        stay = before[len(before) - keep :]
        for version in before[: len(before) - keep]:
            self._objects.remove(self._name(*version))
        for old in sorted(listing.claims - {writer for writer, _ in stay}):
            if old < token:
                self._objects.remove(self._name(old, _CLAIM))

    def _name(self, token: int, rest: str | int) -> str:
        return f"{self.folder}/{token:0{_DIGITS}}/{rest if isinstance(rest, str) else f'{rest:0{_DIGITS}}'}"

    def _read(self, version: tuple[int, int]) -> Snapshot | None:
        """A state; None if it is damaged."""
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
    """The right to write the states of a stream, until another process claims it.

    token    higher than every earlier token
    state    the state to continue from; None if there is none
    """

    def __init__(self, states: StateStore, token: int, state: Snapshot | None) -> None:
        self.token, self.state, self._states = token, state, states
        self._number = 0
        self._fenced: FencedError | None = None

    def write(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Write a state, and remove older ones.

        Raises FencedError if another process has claimed the stream, and again in every later call; StoreError if the
        store fails: the caller continues, and writes a newer state later.
        """
        if self._fenced is not None:
            raise self._fenced
        self._number += 1  # its number is not used again, also if this fails
        with contextlib.suppress(FileExistsError):  # the answer was lost, and the request sent again
            self._states.create(self.token, self._number, files, facts)
        listing = self.check()
        with contextlib.suppress(StoreError):  # they are removed after the next write
            self._states.remove_up_to(self.token, listing, _KEEP)

    def check(self) -> Contents:
        """Raise FencedError if there is a claim with a higher token, or this one was removed."""
        listing = self._states.listed()
        if self.token in listing.claims and max(listing.claims) == self.token:
            return listing
        self._fenced = FencedError(
            f"{self._states.folder} was claimed by another process (token {max(listing.claims, default=0)}) after this "
            f"one (token {self.token}), which has to stop"
        )
        raise self._fenced
