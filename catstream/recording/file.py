"""The file of a recording: messages one after the other, each readable though others are damaged or cut off.

    head      b"catrec", the version of the format (1 byte), a zero byte
    records   length of the message (uint32), CRC-32 of all that follows (uint32), the moment it was
              recorded (float64, seconds since 1970), its `seq` or `version` or 0 (uint64), the message as on the wire

Everything is little-endian. The first message is the `Run`. Records are appended with one write each, so
that a process that is killed leaves at most one torn record, at the end. A reader that meets a damaged record
goes on at the next whole one.

Where `seq` of `Features` goes back, a restarted compressor went on from its checkpoint: they take the
place of those that it had taken after that, and of what was learned from them.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import struct
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Self

from catstream.errors import RecordingError
from catstream.messages import End, Features, Health, Model, Run, Track
from catstream.settings import Settings
from catstream.wire.codec import decode, encode, opening

__all__ = ["KINDS", "Recording", "RecordingWriter", "run_of"]

#: What is recorded.
KINDS = (Run, Features, Model, Track, Health, End)

_HEAD = b"catrec\x01\x00"
_LENGTHS = struct.Struct("<II")
_FACTS = struct.Struct("<dQ")
_LARGEST = 64 << 20  # bytes of a message, as of `Features` on the wire
_WORDS = {Features: "features", Model: "models", Track: "tracks", Health: "reports of health"}
_OPENINGS = {opening(kind): kind for kind in KINDS}
_ANY_OPENING = re.compile(b"|".join(map(re.escape, _OPENINGS)))


def run_of(settings: Settings) -> Run:
    """What a pipeline of this catstream runs with."""
    own = ("run.endpoint", "run.keys")  # of one machine, and of no meaning to others
    return Run(version("catstream"), {name: text for name, text in settings.texts().items() if name not in own})


class RecordingWriter:
    """Writes a recording, or goes on with one; a context manager.

    What `write` returned from is safe from a crash of this process, though not from one of the machine.

    Parameters
    ----------
    path : of the file
    run : what the pipeline runs with
    resume : go on with the file where it is there, after its last whole record

    Raises
    ------
    RecordingError
        Where the file is there already, cannot be written, or is of a pipeline with other settings.
    """

    def __init__(self, path: str | os.PathLike[str], run: Run, *, resume: bool = False) -> None:
        self.path = Path(path)
        self.written = 0  #: messages
        begun = resume and self.path.exists() and self.path.stat().st_size > 0
        earlier = Recording(path) if begun else None
        if earlier is not None and earlier.run != run:
            raise RecordingError(f"{path} records a pipeline with other settings: give another file")
        try:
            self._file = self.path.open("r+b" if begun else "wb" if resume else "xb", buffering=0)
        except FileExistsError:
            raise RecordingError(f"{path} is there already: give another name, or remove it") from None
        except OSError as error:
            raise RecordingError(
                f"cannot record to {str(path)!r} ({error.strerror}): give a place that you may write to"
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise RecordingError(f"somebody else records to {path}: give another name") from None
        if earlier is None:
            self._append(_HEAD + _record(run))
        else:
            self._file.truncate(earlier.size)
            self._file.seek(earlier.size)

    def write(self, message: Any) -> None:
        """Append a message.

        Raises
        ------
        RecordingError
            Where the disk takes no more; the file is then whole up to the message before.
        """
        self._append(_record(message))
        self.written += 1

    def _append(self, record: bytes) -> None:
        start, rest = self._file.tell(), memoryview(record)
        try:
            while rest:  # a full disk takes a part, and then nothing
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._file.truncate(start)
            self._file.seek(start)
            raise RecordingError(f"cannot record to {str(self.path)!r} any more: {error.strerror}") from None

    def close(self) -> None:
        """Close the file; what was written stays."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Recording:
    """A recording, looked through once and checked; it holds no file open.

    Attributes
    ----------
    run : what the pipeline ran with
    counts : messages by kind, `counts[Features]` ...; of features and models those that `features` and `models` give
    missing : features and tracks that should be there and are not, as `seq` tells; also before the first and after
        the last, where the end is there
    end : the pipeline's `End`, None where the recording ended before it
    damaged : bytes between whole records that are none, and are left out
    torn : bytes at the end that are no whole record, and are left out
    size : bytes up to the end of the last whole record

    Raises
    ------
    RecordingError
        Where it cannot be read, or is no recording.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.counts: Counter[type] = Counter()
        self.end: End | None = None
        tracks: set[int] = set()
        self._taken: list[tuple[int, int]] = []  # seq and place of the features that the trees hold
        self._models: list[tuple[int, int]] = []  # seq of the last features it learned from, and place
        self.size, self.damaged = len(_HEAD), 0
        with self._open() as file:
            for place, _, number, data in self._records(file):
                self.damaged += place - self.size
                kind = _kind(data)
                if kind is Features:
                    _go_back(self._taken, number)
                    _go_back(self._models, number)
                    self._taken.append((number, place))
                elif kind is Model:  # a restarted compressor may have it made once more
                    learned = decode(data, Model).frame + 1
                    _go_back(self._models, learned)
                    self._models.append((learned, place))
                elif kind is Track:
                    tracks.add(number)
                elif kind is End:
                    self.end = decode(data, End)
                if kind is not None:
                    self.counts[kind] += 1
                self.size = file.tell()
            self.torn = file.seek(0, os.SEEK_END) - self.size
        self.counts[Features], self.counts[Model] = len(self._taken), len(self._models)
        seqs = {Features: {seq for seq, _ in self._taken}, Track: tracks}
        last = {kind: self.end.seq - 1 if self.end else max(own, default=0) for kind, own in seqs.items()}
        self.missing = {kind: last[kind] - len(own) for kind, own in seqs.items()}
        first = next(self.messages(), (0.0, None))[1]
        if not isinstance(first, Run):
            raise RecordingError(f"{path} does not say what it is a recording of: it was torn before it began")
        self.run = first

    def __str__(self) -> str:
        """What is in it and what is not, for a person."""
        counts = ", ".join(f"{self.counts[kind]} {word}" for kind, word in _WORDS.items())
        lost = [f"{number} {_WORDS[kind]}" for kind, number in self.missing.items() if number]
        damaged = f"; {self.damaged} damaged bytes are left out" * bool(self.damaged)
        torn = f"; {self.torn} torn bytes at its end are left out" * bool(self.torn)
        return f"{counts}, {self.size / 1e6:.0f} MB; {' and '.join(lost) or 'none'} missing{damaged}{torn}"

    @property
    def settings(self) -> Settings:
        """Those of the pipeline.

        Raises
        ------
        SettingsError
            Where this catstream does not know one of them.
        """
        return Settings.of(self.run.settings)

    def messages(self) -> Iterator[tuple[float, Any]]:
        """Every message as it was recorded, with the moment in seconds since 1970."""
        with self._open() as file:
            for _, moment, _, data in self._records(file):
                if (kind := _kind(data)) is not None:
                    yield moment, decode(data, kind)
                if file.tell() >= self.size:
                    return

    def features(self) -> Iterator[Features]:
        """What the coreset trees hold: the features in order of `seq`, each once."""
        return self._at(self._taken, Features)

    def models(self) -> Iterator[Model]:
        """What was learned from these features."""
        return self._at(self._models, Model)

    def _at(self, places: list[tuple[int, int]], kind: type) -> Iterator[Any]:
        with self._open() as file:
            for _, place in places:
                file.seek(place)
                _, _, _, data = next(self._records(file))
                yield decode(data, kind)

    def _open(self) -> BinaryIO:
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"cannot read the recording {self.path}: {error.strerror}") from None
        if file.read(len(_HEAD)) != _HEAD:
            file.close()
            raise RecordingError(f"{self.path} is no recording of this catstream: `catstream record` makes one")
        return file

    @staticmethod
    def _records(file: BinaryIO) -> Iterator[tuple[int, float, int, bytes]]:
        """Place, moment, number and bytes of each whole record, from where the file is."""
        place: int | None = file.tell()
        while place is not None:
            file.seek(place)
            head = file.read(_LENGTHS.size + _FACTS.size)
            if len(head) < _LENGTHS.size + _FACTS.size:
                return
            length, check = _LENGTHS.unpack_from(head)
            data = file.read(length) if length <= _LARGEST else b""
            if len(data) == length and zlib.crc32(data, zlib.crc32(head[_LENGTHS.size :])) == check:
                yield place, *_FACTS.unpack_from(head, _LENGTHS.size), data
                place += len(head) + length
            else:
                place = _next_whole(file, place)


def _next_whole(file: BinaryIO, damaged: int) -> int | None:
    """Place of the first whole record after a damaged one, None if there is none: found by how messages begin."""
    head = _LENGTHS.size + _FACTS.size
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in _ANY_OPENING.finditer(data, damaged + 1 + head):
            place = found.start() - head
            length, check = _LENGTHS.unpack_from(data, place)
            end = found.start() + length
            if length <= _LARGEST and end <= len(data) and zlib.crc32(data[place + _LENGTHS.size : end]) == check:
                return place
    return None


def _go_back(places: list[tuple[int, int]], seq: int) -> None:
    """Forget those from a `seq` on."""
    while places and places[-1][0] >= seq:
        places.pop()


def _record(message: Any) -> bytes:
    data = encode(message)
    facts = _FACTS.pack(time.time(), getattr(message, "seq", getattr(message, "version", 0)))
    return _LENGTHS.pack(len(data), zlib.crc32(data, zlib.crc32(facts))) + facts + data


def _kind(data: bytes) -> type | None:
    """Which message it is, None of a kind that this version does not record."""
    return next((kind for start, kind in _OPENINGS.items() if data.startswith(start)), None)
