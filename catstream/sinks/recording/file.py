"""Recordings: MCAP files of all messages of a run, each readable even if others are damaged or cut off.

A file that was closed or torn cannot be continued: a restarted compressor continues walk.mcap in walk-2.mcap, the next
one in walk-3.mcap, and a file of very many messages is continued in the next one, too. A file belongs to a recording if
the metadata of its topics has the same `recording`, a random number: another recording may be called walk-2.mcap.

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
from collections.abc import Iterable, Iterator, Set
from contextlib import ExitStack
from itertools import count, groupby, islice
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO, Self, TypeVar

from catstream.errors import ProtocolError, RecordingError, require_extra
from catstream.messages.kinds import End, Features, Health, Model, Run, Track
from catstream.messages.names import counted
from catstream.messages.storage import lock
from catstream.settings import Settings
from catstream.sinks.recording.container import (
    INDEX_SIZE,
    MAGIC,
    Container,
    Entry,
    Topic,
    end_of_data,
    entries,
    entry_at,
)
from catstream.wire.codec import decode, decode_json, encode, encode_json

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

_SERIES = "recording"  # metadata of the topics: a random number, the same in all files of a recording
_MOST_MESSAGES = 100_000  # in a file: its index takes 50 MB of memory until it is closed
_Place = tuple[int, int]  # number of the file, and bytes from its start

_NOUNS = {Features: "feature", Model: "model", Track: "track", Health: "health report"}


class RecordingWriter:
    """Writes a recording, or continues one; a context manager.

    When `write` returns, the message survives a crash of this process, though not one of the machine. `close` adds the
    index that other programs need.

    Parameters
    ----------
    path : of the first file
    run : the settings of the pipeline
    resume : continue the recording in its next file, if it exists

    Attributes
    ----------
    written : number of messages written by this object

    Raises
    ------
    RecordingError
        If the file exists already, cannot be written, or was recorded with other settings.
    MissingExtraError
        If the extra `record` is not installed.
    """

    def __init__(self, path: str | os.PathLike[str], run: Run, *, resume: bool = False) -> None:
        require_extra("record")
        self.path, self.written, self._run = Path(path), 0, run
        self._metadata = {_SERIES: token_hex(8)}
        with ExitStack() as self._stack:
            exists = resume and self.path.exists()
            continues = exists and self.path.stat().st_size > 0
            if exists and not continues:
                self.path.unlink()  # its process was killed before it wrote anything
            if continues:
                self._lock()
                earlier, self._metadata = _opening(self.path)
                if earlier != run:
                    raise RecordingError(f"{path} was recorded with other settings: give another file")
            self._container = self._begin(may_exist=continues)
            if not continues:
                self._lock()
            self._stack = self._stack.pop_all()

    def write(self, message: Recorded) -> None:
        """Append a message.

        Raises
        ------
        RecordingError
            If the disk is full or fails; the file then ends with the message before.
        """
        if self._container.messages >= _MOST_MESSAGES and not isinstance(message, End):
            full, self._container = self._container, self._begin(may_exist=True)
            full.close()
        self._add(self._container, message)
        self.written += 1

    def close(self) -> None:
        """Write the index, unless the disk is full, and close the file."""
        self._container.close()
        self._stack.close()

    def _begin(self, *, may_exist: bool) -> Container:
        """Begin the next file of the series, with the settings."""
        path = next(path for path in _numbered(self.path) if not (may_exist and path.exists()))
        try:
            container = Container(path, _TOPICS, self._metadata)
        except FileExistsError:
            raise RecordingError(f"{path} exists already: give another name, or remove it") from None
        except OSError as error:
            raise RecordingError(
                f"cannot record to {str(path)!r} ({error.strerror}): give a path that you may write to"
            ) from None
        try:
            self._add(container, self._run)
        except RecordingError:
            container.close()
            path.unlink()
            raise
        return container

    def _add(self, container: Container, message: Recorded) -> None:
        sequence = getattr(message, "seq", getattr(message, "version", 0))
        data = encode_json(message) if TOPICS[type(message)].encoding == "json" else encode(message)
        try:
            container.add(_NUMBERS[type(message)], sequence, time.time_ns(), data)
        except OSError as error:
            raise RecordingError(f"cannot record to {str(self.path)!r} any more: {error.strerror}") from None

    def _lock(self) -> None:
        """Keep other processes from recording to this series as long as this object is open."""
        if not lock(self._stack.enter_context(_open(self.path)).fileno()):
            raise RecordingError(f"another process records to {self.path}: give another name")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Recording:
    """A recording that was read and checked once from start to end; it keeps no file open.

    Attributes
    ----------
    path : of its first file
    files : all of its files, in order
    run : the settings of the pipeline
    counts : messages by kind, `counts[Features]` ...; of features and models those that `features` and `models` yield,
        of tracks one of each object in a frame
    missing : frames whose features or tracks are missing, by the gaps in `seq`; also before the first and, if the end
        was recorded, after the last
    frames : number of frames that have a track
    end : the pipeline's `End`, None if the recording ended before it
    damaged : bytes between whole messages that are skipped
    torn : bytes after the last whole message of a file that are skipped
    size : bytes up to the end of the last whole message, of all files

    Raises
    ------
    RecordingError
        If a file cannot be read, or is not a recording.
    MissingExtraError
        If the extra `record` is not installed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        require_extra("record")
        self.path = Path(path)
        self.run, metadata = _opening(self.path)
        self.files = [self.path, *_further(self.path, metadata)]
        self.counts: Counter[type] = Counter()
        self.end: End | None = None
        self.damaged = self.torn = 0
        self._ends: list[int] = []  # of the last whole message of each file
        self._tracks: defaultdict[int, set[str]] = defaultdict(set)  # the objects of each frame, by seq
        self._features: list[tuple[int, _Place]] = []  # seq and place of the features that the trees hold
        # Of each object: number of features that a model was trained on, and its place.
        self._models: defaultdict[str, list[tuple[int, _Place]]] = defaultdict(list)
        for number in range(len(self.files)):
            self._read(number)
        self.counts[Features] = len(self._features)
        self.counts[Model] = sum(map(len, self._models.values()))
        self.counts[Track] = sum(map(len, self._tracks.values()))
        self.size, self.frames = sum(self._ends), len(self._tracks)
        self.missing = {
            Features: self._missing({seq for seq, _ in self._features}),
            Track: self._missing(self._tracks.keys()),
        }

    def __str__(self) -> str:
        """A summary for a person."""
        counts = ", ".join(counted(self.counts[kind], noun) for kind, noun in _NOUNS.items())
        files = f" in {len(self.files)} files" * (len(self.files) > 1)
        lost = [counted(number, _NOUNS[kind]) for kind, number in self.missing.items() if number]
        damaged = f"; {counted(self.damaged, 'damaged byte')} skipped" * bool(self.damaged)
        torn = f"; {counted(self.torn, 'torn byte')} at the end of a file skipped" * bool(self.torn)
        cut = "; it ends before the run did" * (self.end is None)
        return f"{counts}, {self.size / 1e6:.0f} MB{files}; {' and '.join(lost) or 'none'} missing{cut}{damaged}{torn}"

    @property
    def complete(self) -> bool:
        """Whether it has all features and tracks from its first frame to the end of the run."""
        seqs: tuple[Set[int], ...] = ({seq for seq, _ in self._features}, self._tracks.keys())
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
        """Each message in the order of recording, with its time in seconds since 1970; the settings once, first."""
        for number, path in enumerate(self.files):
            with _open(path) as file:
                for entry in entries(file):
                    kind = _KINDS.get(entry.channel)
                    if kind is not None and not (number and kind is Run):
                        yield entry.time / 1e9, _decode(path, entry, kind)
                    if entry.end >= self._ends[number]:  # the file may have grown since it was checked
                        break

    def features(self) -> Iterator[Features]:
        """The features that the coreset trees hold, in order of `seq`, each once."""
        return self._at((place for _, place in self._features), Features)

    def models(self) -> Iterator[Model]:
        """The models of all objects that were trained on these features, in the order of recording."""
        return self._at(sorted(place for models in self._models.values() for _, place in models), Model)

    def _at(self, places: Iterable[_Place], kind: type[_Kind]) -> Iterator[_Kind]:
        for number, group in groupby(places, key=lambda place: place[0]):
            path = self.files[number]
            with _open(path) as file:
                for _, place in group:
                    entry = entry_at(file, place)
                    if entry is None:
                        raise RecordingError(f"{path} has changed since it was checked: read it again")
                    yield _decode(path, entry, kind)

    def _read(self, number: int) -> None:
        """Check a file, and take in its messages."""
        with _open(self.files[number]) as file:
            end = expected = len(MAGIC)
            for entry in entries(file):
                self.damaged += max(entry.place - expected, 0) if end > len(MAGIC) else 0
                end, expected = entry.end, entry.end + INDEX_SIZE
                self._count(entry, number)
            self._ends.append(end)
            closed = end_of_data(file)
            if closed is not None and closed >= expected:
                self.damaged += closed - expected
            else:
                self.torn += max(file.seek(0, os.SEEK_END) - expected, 0)

    def _count(self, entry: Entry, number: int) -> None:
        """Take in an entry while a file is checked."""
        kind, place = _KINDS.get(entry.channel), (number, entry.place)
        if kind is None or (number and kind is Run):  # of a later version, or repeated
            return
        self.counts[kind] += 1
        if kind is Features:
            if not self._features:  # an earlier protocol is rejected before anything is played or learned
                _decode(self.files[number], entry, Features)
            if self.end is not None and entry.sequence >= self.end.seq:  # that run was stopped, and was resumed
                self.end = None
            for places in (self._features, *self._models.values()):
                _drop_from(places, entry.sequence)
            self._features.append((entry.sequence, place))
        elif kind is Model:  # a restarted compressor may have it trained again
            model = _decode(self.files[number], entry, Model)
            models, trained = self._models[model.object], model.frame + 1
            _drop_from(models, trained)
            models.append((trained, place))
        elif kind is Track:  # a restarted detector may have repeated it
            self._tracks[entry.sequence].add(_decode(self.files[number], entry, Track).object)
        elif kind is End:
            self.end = _decode(self.files[number], entry, End)

    def _missing(self, seqs: Set[int]) -> int:
        # The end has a lower number if the source failed while a restarted detector repeated frames.
        return max(self.end.seq - 1 if self.end else 0, max(seqs, default=0)) - len(seqs)


def _drop_from(places: list[tuple[int, _Place]], seq: int) -> None:
    """Remove the places of a `seq` and of all later ones."""
    while places and places[-1][0] >= seq:
        places.pop()


def _numbered(path: Path) -> Iterator[Path]:
    """Yield the names of the files of a series: walk.mcap, walk-2.mcap, walk-3.mcap ..."""
    yield path
    for number in count(2):
        yield path.with_name(f"{path.stem}-{number}{path.suffix}")


def _further(path: Path, metadata: dict[str, str]) -> Iterator[Path]:
    """Yield the further files of a recording; also one whose beginning is damaged, so that it does not say of what."""
    for other in islice(_numbered(path), 1, None):
        if not other.exists():
            return
        with other.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                first = next(entries(file), None)
                if first is None or _KINDS.get(first.channel) is not Run or first.metadata == metadata:
                    yield other


def _opening(path: Path) -> tuple[Run, dict[str, str]]:
    """Return the settings in the first message of a file, and the metadata of its topics."""
    with _open(path) as file:
        first = next(entries(file), None)
    if first is None or _KINDS.get(first.channel) is not Run:
        raise RecordingError(f"{path} holds no settings of a run: it was cut off or damaged at its start")
    return _decode(path, first, Run), first.metadata


def _open(path: Path) -> BinaryIO:
    try:
        file = path.open("rb")
    except OSError as error:
        raise RecordingError(f"cannot read the recording {path}: {error.strerror}") from None
    if file.read(len(MAGIC)) != MAGIC:
        file.close()
        raise RecordingError(f"{path} is not a recording of this version of catstream: `catstream record` makes one")
    return file


def _decode(path: Path, entry: Entry, kind: type[_Kind]) -> _Kind:
    try:
        return decode_json(entry.data, kind) if TOPICS[kind].encoding == "json" else decode(entry.data, kind)
    except ProtocolError as error:
        raise RecordingError(
            f"{path} holds a message at byte {entry.place} that this version of catstream cannot read: {error}"
        ) from None
