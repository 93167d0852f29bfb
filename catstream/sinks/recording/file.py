"""Recordings: an MCAP file of all messages of a run, each readable even if others are damaged or cut off.

A topic for each kind of message. Messages without arrays are JSON objects of their fields, which Foxglove and other
programs show as they are; features and models are msgpack, as on the wire. The tracks and models of all objects are in
one topic; their field `object` has the name. The first message is the `Run`.

If `seq` of `Features` goes back, a restarted compressor has continued from its checkpoint: the later features replace
those from the same `seq` on, and the models that were trained on them.
"""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Self, TypeVar

from catstream.errors import ProtocolError, RecordingError
from catstream.messages.kinds import End, Features, Health, Model, Run, Track
from catstream.messages.names import counted
from catstream.messages.storage import lock
from catstream.settings import Settings
from catstream.sinks.recording.container import (
    MAGIC,
    Entry,
    Index,
    Topic,
    end_of_data,
    entries,
    entry_at,
    opening,
    pack,
    summary,
)
from catstream.wire.codec import decode, decode_json, encode, encode_json

__all__ = ["TOPICS", "Recorded", "Recording", "RecordingWriter"]

#: The kinds of message in a recording.
Recorded = Run | Features | Model | Track | Health | End
_Kind = TypeVar("_Kind", bound=Recorded)

_ENVELOPE = "msgpack, [version, kind, object, fields]; an array in fields is {dtype, shape, data: bytes row by row}"

#: Kind of message -> its topic. Topics are numbered from 1 in this order: a new one comes last.
TOPICS: dict[type, Topic] = {
    Run: Topic("run", "json"),
    Features: Topic("features", "msgpack", f"{_ENVELOPE}\n\n{Features.__doc__}"),
    Model: Topic("models", "msgpack", f"{_ENVELOPE}\n\n{Model.__doc__}"),
    Track: Topic("tracks", "json"),
    Health: Topic("health", "json"),
    End: Topic("end", "json"),
}
_TOPICS = list(TOPICS.values())
_NUMBERS = {kind: number for number, kind in enumerate(TOPICS, 1)}
_KINDS = {number: kind for kind, number in _NUMBERS.items()}

_NOUNS = {Features: "feature", Model: "model", Track: "track", Health: "health report"}


class RecordingWriter:
    """Writes a recording, or continues one; a context manager.

    When `write` returns, the message survives a crash of this process, though not one of the machine. `close` adds the
    index that other programs need.

    Parameters
    ----------
    path : of the file
    run : the settings of the pipeline
    resume : continue the file after its last whole message, if it exists

    Attributes
    ----------
    written : number of messages written by this object

    Raises
    ------
    RecordingError
        If the file exists already, cannot be written, or was recorded with other settings.
    """

    def __init__(self, path: str | os.PathLike[str], run: Run, *, resume: bool = False) -> None:
        self.path = Path(path)
        self.written = 0
        continued = resume and self.path.exists() and self.path.stat().st_size > 0
        try:
            self._file = self.path.open("r+b" if continued else "wb" if resume else "xb", buffering=0)
        except FileExistsError:
            raise RecordingError(f"{path} exists already: give another name, or remove it") from None
        except OSError as error:
            raise RecordingError(
                f"cannot record to {str(path)!r} ({error.strerror}): give a path that you may write to"
            ) from None
        if not lock(self._file.fileno()):
            self._file.close()
            raise RecordingError(f"another process records to {path}: give another name")
        earlier = Recording(path) if continued else None  # nobody else may write to it from here on
        if earlier is not None and earlier.run != run:
            self._file.close()
            raise RecordingError(f"{path} was recorded with other settings: give another file")
        self._index, self._size = (earlier.index, earlier.size) if earlier is not None else (Index(), 0)
        if earlier is None:
            self._add(run, opening(_TOPICS))
        else:
            self._cut()

    def write(self, message: Recorded) -> None:
        """Append a message.

        Raises
        ------
        RecordingError
            If the disk is full or fails; the file then ends with the message before.
        """
        self._add(message)
        self.written += 1

    def close(self) -> None:
        """Write the index, unless the disk is full, and close the file."""
        if self._file.closed:
            return
        size = self._size
        try:
            for block in summary(_TOPICS, self._index, size):
                self._append(block)
        except RecordingError:  # the index can be made from the messages
            self._size = size
            self._cut()
        self._file.close()

    def _add(self, message: Recorded, before: bytes = b"") -> None:
        number, now = _NUMBERS[type(message)], time.time_ns()
        sequence = getattr(message, "seq", getattr(message, "version", 0))
        data = encode_json(message) if TOPICS[type(message)].encoding == "json" else encode(message)
        entry = pack(number, sequence, now, data)
        place = self._size + len(before)
        self._append(before + entry)
        self._index.add(place, len(entry), number, now)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:  # a disk that becomes full takes a part, and then nothing
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._cut()
            raise RecordingError(f"cannot record to {str(self.path)!r} any more: {error.strerror}") from None
        self._size += len(data)

    def _cut(self) -> None:
        """Remove all bytes after those that were written whole."""
        self._file.truncate(self._size)
        self._file.seek(self._size)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Recording:
    """A recording that was read and checked once from start to end; it keeps no file open.

    Attributes
    ----------
    run : the settings of the pipeline
    counts : messages by kind, `counts[Features]` ...; of features and models those that `features` and `models` yield
    missing : frames whose features or tracks are missing, by the gaps in `seq`; also before the first and, if the end
        was recorded, after the last
    frames : number of frames that have a track
    end : the pipeline's `End`, None if the recording ended before it
    damaged : bytes between whole messages that are skipped
    torn : bytes after the last whole message that are skipped
    size : bytes up to the end of the last whole message
    index : places of all whole messages

    Raises
    ------
    RecordingError
        If the file cannot be read, or is not a recording.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.counts: Counter[type] = Counter()
        self.end: End | None = None
        self.index = Index()
        self.size = self.damaged = 0
        self._tracks: set[int] = set()
        self._features: list[tuple[int, int]] = []  # seq and place of the features that the trees hold
        # Of each object: number of features that a model was trained on, and its place.
        self._models: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
        with self._open() as file:
            for entry in entries(file):
                self.damaged += entry.place - (self.size or entry.place)
                self.size = entry.place + entry.size
                self.index.add(entry.place, entry.size, entry.channel, entry.time)
                self._count(entry)
            self._measure_tail(file)
        _, first = next(self.messages(), (0.0, None))
        if not isinstance(first, Run):
            raise RecordingError(f"{path} holds no settings of a run: it was cut off or damaged at its start")
        self.run = first
        self.counts[Features] = len(self._features)
        self.counts[Model] = sum(map(len, self._models.values()))
        self.frames = len(self._tracks)
        self.missing = {
            Features: self._missing({seq for seq, _ in self._features}),
            Track: self._missing(self._tracks),
        }

    def __str__(self) -> str:
        """A summary for a person."""
        counts = ", ".join(counted(self.counts[kind], noun) for kind, noun in _NOUNS.items())
        lost = [counted(number, _NOUNS[kind]) for kind, number in self.missing.items() if number]
        damaged = f"; {counted(self.damaged, 'damaged byte')} skipped" * bool(self.damaged)
        torn = f"; {counted(self.torn, 'torn byte')} at its end skipped" * bool(self.torn)
        cut = "; it ends before the run did" * (self.end is None)
        return f"{counts}, {self.size / 1e6:.0f} MB; {' and '.join(lost) or 'none'} missing{cut}{damaged}{torn}"

    @property
    def complete(self) -> bool:
        """Whether it has all features and tracks from its first frame to the end of the run."""
        seqs: tuple[set[int], ...] = ({seq for seq, _ in self._features}, self._tracks)
        return self.end is not None and all(self._missing(each) == min(each, default=1) - 1 for each in seqs)

    @property
    def settings(self) -> Settings:
        """The settings of the pipeline.

        Raises
        ------
        SettingsError
            If this version of catstream does not know one of them.
        """
        return Settings.from_values(self.run.settings)

    def messages(self) -> Iterator[tuple[float, Recorded]]:
        """Each message in the order of recording, with its time in seconds since 1970."""
        with self._open() as file:
            for entry in entries(file):
                if entry.channel in _KINDS:
                    yield entry.time / 1e9, self._decode(entry, _KINDS[entry.channel])
                if entry.place + entry.size >= self.size:  # the file may have grown since it was checked
                    return

    def features(self) -> Iterator[Features]:
        """The features that the coreset trees hold, in order of `seq`, each once."""
        return self._at((place for _, place in self._features), Features)

    def models(self) -> Iterator[Model]:
        """The models of all objects that were trained on these features, in the order of recording."""
        return self._at(sorted(place for models in self._models.values() for _, place in models), Model)

    def _at(self, places: Iterable[int], kind: type[_Kind]) -> Iterator[_Kind]:
        with self._open() as file:
            for place in places:
                entry = entry_at(file, place)
                if entry is None:
                    raise RecordingError(f"{self.path} has changed since it was checked: read it again")
                yield self._decode(entry, kind)

    def _decode(self, entry: Entry, kind: type[_Kind]) -> _Kind:
        try:
            return decode_json(entry.data, kind) if TOPICS[kind].encoding == "json" else decode(entry.data, kind)
        except ProtocolError as error:
            raise RecordingError(
                f"{self.path} holds a message at byte {entry.place} that this version of catstream cannot read: {error}"
            ) from None

    def _open(self) -> BinaryIO:
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"cannot read the recording {self.path}: {error.strerror}") from None
        if file.read(len(MAGIC)) != MAGIC:
            file.close()
            raise RecordingError(f"{self.path} is no recording of this catstream: `catstream record` makes one")
        return file

    def _count(self, entry: Entry) -> None:
        """Take in an entry while the file is checked."""
        kind = _KINDS.get(entry.channel)
        if kind is None:  # of a later version
            return
        self.counts[kind] += 1
        if kind is Features:
            if (
                not self._features
            ):  # an earlier version of the protocol is rejected before anything is played or learned
                self._decode(entry, Features)
            for places in (self._features, *self._models.values()):
                _drop_from(places, entry.sequence)
            self._features.append((entry.sequence, entry.place))
        elif kind is Model:  # a restarted compressor may have it trained again
            model = self._decode(entry, Model)
            places, trained = self._models[model.object], model.frame + 1
            _drop_from(places, trained)
            places.append((trained, entry.place))
        elif kind is Track:
            self._tracks.add(entry.sequence)
        elif kind is End:
            self.end = self._decode(entry, End)

    def _measure_tail(self, file: BinaryIO) -> None:
        """Count the bytes after the last whole message that are not the index."""
        end = end_of_data(file)
        if end is not None and end >= self.size:
            self.damaged, self.torn = self.damaged + end - self.size, 0
        else:
            self.torn = file.seek(0, os.SEEK_END) - self.size

    def _missing(self, seqs: set[int]) -> int:
        last = self.end.seq - 1 if self.end else max(seqs, default=0)
        return last - len(seqs)


def _drop_from(places: list[tuple[int, int]], seq: int) -> None:
    """Remove the places of a `seq` and of all later ones."""
    while places and places[-1][0] >= seq:
        places.pop()
