"""The states of a stream as a log of numbered objects, which only the newest holder of the stream can continue.

The objects of a log are numbered 1, 2, 3 ... Each is created exclusively: this fails if the number is taken. An object
is

    a claim   it makes its writer the holder of the stream, and its number is the fencing token
    a state   the files of a stream, written by its holder every few seconds

and records its writer and the states and claims before it, so that a reader needs to read only the newest one.

    claim   take the number after the newest one; then list the log: if there is a newer object by now, claim again
    write   take the next number; if it is taken, read it: another writer's object means that this holder is fenced
    read    take the newest undamaged object: it is a state, or a claim that names the state to continue from

A holder that was paused finds the next claim at its next number. What can fail besides:

    the answer to a write is lost   The caller writes again. The number is taken by an object of the same writer: that
                                    write was successful. If the number is free, the log is listed after the write,
                                    because the first object may have been stored and removed by a newer holder.
    a write ends half way           The object is damaged. Its number stays taken; the writer uses the next number.
    two claims at once              One of them does not get the number, and takes a later one: the last claim counts.
    many claims                     The newest 100 are kept. Older ones are removed, the oldest first, and a write is
                                    valid only if the claim of its writer still exists after it.

A holder removes its states but the newest two. A stream that was removed keeps its claims, so that its numbers go on.
See docs/decisions/0059-numbered-objects.md.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from catstream import storage
from catstream.errors import FencedError, ProtocolError, StoreError

__all__ = ["LARGEST_CLAIM", "Claim", "Generation", "Log", "Objects"]

#: Bytes of the largest possible claim: a larger object is a state.
LARGEST_CLAIM = 8192

_DIGITS = 12  # of an object's number in its name
_STATES = 2  # that are kept
_CLAIMS = 100  # that are kept
_ATTEMPTS = 20  # to append an object, or to read the newest one, while other processes change the log
_LONGEST_HOLDER = 200


class Objects(Protocol):
    """Named objects that are created exclusively and never changed."""

    def create(self, name: str, data: bytes) -> None:
        """Create an object.

        Raises
        ------
        FileExistsError
            If the name is taken.
        StoreError
            If the store cannot be reached or is full. The object may nevertheless have been created.
        """

    def read(self, name: str) -> bytes:
        """Return the content of an object; FileNotFoundError if there is none, StoreError as in `create`."""

    def exists(self, name: str) -> bool:
        """Return whether there is such an object."""

    def sizes(self, folder: str) -> dict[str, int]:
        """Return the sizes of all objects below a folder, by the part of their names below it."""

    def remove(self, name: str) -> None:
        """Remove an object, if it exists."""

    def tidy(self, folder: str) -> None:
        """Remove what killed processes left in a folder."""


@dataclass(frozen=True, slots=True)
class Generation:
    """A state of a stream in the store.

    number  position in the log
    files   contents by name
    facts   JSON: frame, time and whatever else the writer added
    """

    number: int
    files: dict[str, bytes] = field(repr=False)
    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Record:
    """An object of the log.

    kind    claim or state
    writer  random identity of the claim that wrote it
    holder  name of the writer, for messages
    serial  number of the call of `Claim.write`, 0 in a claim
    states  numbers of the states to continue from, oldest first; includes the record itself if it is a state
    claims  numbers of the claims that are kept, oldest first; includes the record itself if it is a claim
    """

    kind: Literal["claim", "state"]
    writer: str
    holder: str
    serial: int
    states: tuple[int, ...]
    claims: tuple[int, ...]
    files: Mapping[str, bytes] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)

    def encode(self) -> bytes:
        """Return the content of the object, with a checksum."""
        arrays = {name: np.frombuffer(content, np.uint8) for name, content in self.files.items()}
        header = {key: getattr(self, key) for key in ("kind", "writer", "holder", "serial", "states", "claims")}
        return storage.encode(arrays, {**header, "facts": dict(self.facts)})

    @classmethod
    def decode(cls, data: bytes, name: str) -> _Record:
        """Read the content of an object; ProtocolError if it is damaged."""
        arrays, header = storage.decode(data, name)
        try:
            header |= {key: tuple(map(int, header[key])) for key in ("states", "claims")}
            return cls(**header, files={key: array.tobytes() for key, array in arrays.items()})
        except (KeyError, TypeError, ValueError):
            raise ProtocolError(f"{name} is not an object of a log: it was not written by this catstream") from None


_EMPTY = _Record("claim", writer="", holder="", serial=0, states=(), claims=())


class Log:
    """A log in a folder of the store."""

    def __init__(self, objects: Objects, folder: str) -> None:
        self._objects = objects
        self.folder = folder

    def newest(self, after: int = 0) -> Generation | None:
        """Return the newest state; None if there is none with a number above `after`."""
        _, _, state = self._read_newest(after)
        return state if state and state.number > after else None

    def claim(self, holder: str) -> Claim:
        """Become the holder of this log, whose name is for messages. Earlier holders can write no more."""
        writer = secrets.token_hex(8)
        for _ in range(_ATTEMPTS):
            numbers, head, state = self._read_newest()
            number = max(numbers, default=0) + 1
            states = tuple(old for old in head.states if state and old <= state.number)
            claims = (*head.claims, number)[-_CLAIMS:]
            record = _Record("claim", writer, holder[:_LONGEST_HOLDER], 0, states, claims)
            if self._create(number, record) and max(self.numbers()) == number:
                self._remove_below(record, numbers)
                return Claim(self, number, record, state)
        raise self._busy("claimed")

    def clear(self, holder: str) -> None:
        """Remove the states of this log. Its holder, if there is one, can write no more."""
        if self.numbers():
            self.claim(holder).remove_states()

    def numbers(self) -> set[int]:
        """The numbers of all objects."""
        return {int(name) for name in self._objects.sizes(self.folder) if len(name) == _DIGITS and name.isdecimal()}

    def create(self, number: int, record: _Record) -> None:
        """Create an object; FileExistsError if the number is taken."""
        self._objects.create(self._name(number), record.encode())

    def read(self, number: int) -> _Record:
        """Return an object; FileNotFoundError if there is none, ProtocolError if it is damaged."""
        name = self._name(number)
        return _Record.decode(self._objects.read(name), name)

    def exists(self, number: int) -> bool:
        """Return whether a number is taken."""
        return self._objects.exists(self._name(number))

    def remove(self, number: int) -> None:
        """Remove an object."""
        self._objects.remove(self._name(number))

    def _name(self, number: int) -> str:
        return f"{self.folder}/{number:0{_DIGITS}}"

    def _create(self, number: int, record: _Record) -> bool:
        """Create a claim; False if another writer's object has its number."""
        try:
            self.create(number, record)
        except FileExistsError:
            with contextlib.suppress(FileNotFoundError, ProtocolError):
                return self.read(number).writer == record.writer
            return False
        return True

    def _read_newest(self, after: int = 0) -> tuple[set[int], _Record, Generation | None]:
        """All numbers, the newest undamaged object, and the state to continue from."""
        for _ in range(_ATTEMPTS):
            numbers = self.numbers()
            if max(numbers, default=0) <= after:
                return numbers, _EMPTY, None
            with contextlib.suppress(FileNotFoundError):  # removed by the holder since the log was listed
                newest = self._undamaged(sorted(numbers, reverse=True))
                head = newest[1] if newest else _EMPTY
                before = [number for number in reversed(head.states) if number in numbers]
                found = newest if head.kind == "state" else self._undamaged(before)
                state = Generation(found[0], dict(found[1].files), dict(found[1].facts)) if found else None
                return numbers, head, state
        raise self._busy("read")

    def _undamaged(self, numbers: list[int]) -> tuple[int, _Record] | None:
        """The first undamaged object of the given ones, with its number."""
        for number in numbers:
            with contextlib.suppress(ProtocolError):
                return number, self.read(number)
        return None

    def _remove_below(self, record: _Record, numbers: set[int]) -> None:
        """Remove everything older than the oldest claim to keep, except the states to continue from.

        The order matters: a holder whose own claim exists relies on it that no later claim was removed.
        """
        with contextlib.suppress(StoreError):  # the next claim removes the rest
            self._objects.tidy(self.folder)
            if len(record.claims) == _CLAIMS:
                for number in sorted(numbers - set(record.states)):
                    if number < record.claims[0]:
                        self.remove(number)

    def _busy(self, what: str) -> StoreError:
        return StoreError(f"{self.folder} could not be {what}: other processes change it all the time; try again later")


class Claim:
    """The right to write the states of a stream, until another process claims it.

    token   fencing token: higher than that of every earlier claim
    state   the state to continue from; None if there is none
    """

    def __init__(self, log: Log, number: int, record: _Record, state: Generation | None) -> None:
        self.token = number
        self.state = state
        self._log = log
        self._writer, self._holder, self._claims = record.writer, record.holder, record.claims
        self._states = list(record.states)
        self._serial = 0
        self._next = number + 1
        self._unsure = False  # whether an object may have been created at the next number already
        self._fenced: FencedError | None = None

    def __repr__(self) -> str:
        return f"Claim({self._log.folder!r}, token={self.token})"

    def write(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> None:
        """Append a state, and remove states that are no longer needed.

        Parameters
        ----------
        files : contents by name
        facts : JSON about the state: frame, time ...

        Raises
        ------
        FencedError
            If another process has claimed the stream. Every later call raises it too.
        StoreError
            If the store cannot be reached or is full. The caller goes on, and writes a newer state later.
        """
        if self._fenced:
            raise self._fenced
        self._serial += 1
        for _ in range(_ATTEMPTS):
            if self._append(files, facts):
                with contextlib.suppress(StoreError):  # they are removed after the next write
                    self.remove_states(keep=_STATES)
                return
        raise StoreError(f"no state could be added to {self._log.folder}: the numbers after {self._next} are taken")

    def _append(self, files: Mapping[str, bytes], facts: Mapping[str, Any]) -> bool:
        """Create a state at the next number; False if the caller has to try again."""
        number = self._next
        states = (*self._states, number)
        record = _Record("state", self._writer, self._holder, self._serial, states, self._claims, files, facts)
        unsure, self._unsure = self._unsure, True  # until the answer to the write is known
        try:
            self._log.create(number, record)
        except FileExistsError:
            if not self._is_written(number):
                return False
        valid = max(self._log.numbers()) == number if unsure else self._log.exists(self.token)
        if not valid:  # the object stays: a newer holder may continue from it
            raise self._fence("another process")
        self._advance(number, states)
        return True

    def _is_written(self, number: int) -> bool:
        """Whether the object at a number that is taken is the state of this very call of `write`."""
        try:
            found = self._log.read(number)
        except FileNotFoundError:  # the store refused two writers at the same moment
            return False
        except ProtocolError:  # a write that ended half way
            self._advance(number, tuple(self._states))
            return False
        if found.writer != self._writer:
            raise self._fence(found.holder)
        if found.serial < self._serial:
            self._advance(number, found.states)
        return found.serial == self._serial

    def _advance(self, number: int, states: tuple[int, ...]) -> None:
        self._states = list(states)
        self._next = number + 1
        self._unsure = False

    def _fence(self, holder: str) -> FencedError:
        self._fenced = FencedError(
            f"{self._log.folder} was claimed by {holder} after {self._holder} (token {self.token}): "
            f"{self._holder} may not write it any more, and has to stop"
        )
        return self._fenced

    def remove_states(self, keep: int = 0) -> None:
        """Remove all states of the log but the newest ones."""
        while len(self._states) > keep:
            self._log.remove(self._states[0])
            del self._states[0]
