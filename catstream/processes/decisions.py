"""Decisions as pure functions: where a detector continues and when it waits, and what a compressor stores.

Commands set the desired state. It is stored on disk for a detector that is restarted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Self

import msgspec

from catstream.base.box import Box
from catstream.base.files import write_atomically
from catstream.errors import ProtocolError
from catstream.wire.messages import DetectorState, Position

_MOST_SAMPLES = 65536  # changes of the newest samples that are stored until `samples` returns them
_SYNC_SECONDS = 60.0  # shortest time between two checkpoints that are forced to disk
_SYNC_RATE = 0.3e6  # bytes per second that they write at most, on average
_REST = 9.0  # from one checkpoint to the next, times the duration of the last one


@dataclass(frozen=True, slots=True)
class DesiredObject:
    """An object that is to be tracked.

    box      the object in its first frame; the last box in the saved model if the object begins with one
    begins   seq of the message of its first frame
    model    name of the saved model that it begins with, see `catstream.processes.model_files`; empty without one
    size     bytes of the saved model
    version  of the saved model
    """

    box: Box
    begins: int
    model: str = ""
    size: int = 0
    version: int = 0


@dataclass(frozen=True, slots=True)
class DesiredState:
    """The state of a run that holds until a command changes it.

    objects  the objects by name, in the order in which they began; empty before a box is set
    paused   whether tracking is paused
    stopped  whether the stream is to end
    """

    objects: dict[str, DesiredObject] = field(default_factory=dict)
    paused: bool = False
    stopped: bool = False

    def with_object(self, name: str, desired: DesiredObject) -> DesiredState:
        """The state with one more object, which replaces another one of its name."""
        return replace(self, objects=self.without(name).objects | {name: desired})

    def without(self, name: str) -> DesiredState:
        """The state without an object."""
        return replace(self, objects={other: item for other, item in self.objects.items() if other != name})

    def save(self, path: Path) -> None:
        """Write the state to a file atomically; OSError if it cannot be written."""
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomically(path, msgspec.json.encode(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote; ProtocolError if the file cannot be read."""
        try:
            return msgspec.json.decode(path.read_bytes(), type=cls)
        except (OSError, msgspec.DecodeError) as error:
            raise ProtocolError(
                f"cannot read the desired state in {path} ({error!r}): the run starts with its original boxes; "
                "repeat later commands"
            ) from None


@dataclass(frozen=True, slots=True)
class Start:
    """Where a restarted detector continues.

    seq      the last message before it
    repeats  the last message that an earlier detector has sent: commands and pauses apply after it
    desired  the objects; those that cannot continue begin again
    states   the state of each object's detector that continues, with the newest model, by name
    """

    seq: int
    repeats: int
    desired: DesiredState
    states: dict[str, DetectorState]


def resume_at(position: Position, after: int | None, desired: DesiredState, *, live: bool) -> Start:
    """Return where a detector continues: after the last frame that the compressor and the program have.

    An object without a model begins again; only the SCM bootstrap, which is not stored, takes longer than a frame.

    Parameters
    ----------
    position : answer of the compressor, with the states after message `after`
    after : number of the last message that the program has; None if the processes were started by hand
    """
    # Step 1: the last message of both. Frames of a live source cannot be read again: it continues after the last one
    # that was learned from.
    after = position.processed if live or after is None else after
    seq, repeats = sorted((after, position.processed))
    # Step 2: if no object has a model yet, a file is tracked again from the first frame of the first object.
    if not (live or position.versions):
        return Start(min([seq, *(item.begins - 1 for item in desired.objects.values())]), repeats, desired, {})
    # Step 3: objects with a model continue. The others begin again at their last known boxes, or are searched for with
    # their saved models.
    trained = position.states.keys() & position.versions.keys()
    states: dict[str, DetectorState] = {}
    for name, item in desired.objects.items():
        if item.begins > seq:
            continue
        if name in trained:
            states[name] = position.states[name]
        else:
            state = None if item.model else position.states.get(name)
            box = item.box if state is None else state.window.box()
            desired = desired.with_object(name, replace(item, box=box, begins=seq + 1))
    return Start(seq, repeats, desired, states)


def have_arrived(position: Position, desired: DesiredState, arrived: Mapping[str, int]) -> bool:
    """Return True once every model has the version of the compressor's newest sample.

    Compressor and trainer may have been restarted as well, and then repeat their last steps.
    """
    return all(arrived.get(name) == version for name, version in position.versions.items() if name in desired.objects)


class TrainingLag:
    """The samples that features have led to: a detector in lockstep, or with `lag_frames`, waits for their models."""

    def __init__(self, processed: int = 0) -> None:
        self.processed = processed  #: seq of the newest features that the compressor has processed
        self._changes: deque[tuple[int, dict[str, int]]] = deque(maxlen=_MOST_SAMPLES)  # seq that led to these versions
        self._newest: dict[str, int] = {}  # the versions of the last reply
        self._returned: dict[str, int] = {}  # by `samples`

    def reply(self, processed: int, versions: dict[str, int]) -> None:
        """Note a reply of the compressor: the seq that it has processed, and the versions of its newest samples.

        If it did not reply to each message, a sample counts from the first message that it may be of.
        """
        if versions != self._newest:
            self._changes.append((self.processed + 1, versions))
            self._newest = versions
        self.processed = processed

    def samples(self, seq: int) -> dict[str, int]:
        """The newest version of each object's samples that the features up to `seq` led to; `seq` never falls."""
        while self._changes and self._changes[0][0] <= seq:
            self._returned = self._changes.popleft()[1]
        return self._returned

    def awaited(self, required: int, newest: Mapping[str, int]) -> Literal["", "features", "models"]:
        """The channel on which a detector waits before its next frame; "" to continue at once.

        required  seq of the newest features that the models must include
        newest    version of the newest model of each object that had begun before `required`

        >>> lag = TrainingLag(processed=6)
        >>> lag.awaited(required=7, newest={"": 2})
        'features'
        >>> lag.reply(8, {"": 3})
        >>> lag.awaited(required=7, newest={"": 2}), lag.awaited(required=7, newest={"": 3})
        ('models', '')
        """
        if self.processed < required:
            return "features"
        samples = self.samples(required).items()
        return "models" if any(newest[name] < version for name, version in samples if name in newest) else ""


def checkpoint_is_due(since: float, took: float, interval: float) -> bool:
    """Return True if the interval is over, `since` seconds after the last checkpoint; one takes `took` seconds.

    It grows with the trees: at most a tenth of the time is spent.

    >>> checkpoint_is_due(since=1.5, took=0.02, interval=1), checkpoint_is_due(since=1.5, took=0.2, interval=1)
    (True, False)
    """
    return since >= max(interval, _REST * took)


def sync_interval(size: int) -> float:
    """Seconds between two durable checkpoints of `size` bytes: an SD card takes 0.3 MB/s for years.

    >>> sync_interval(15_000_000), sync_interval(150_000_000)
    (60.0, 500.0)
    """
    return max(_SYNC_SECONDS, size / _SYNC_RATE)


def stored(position: Position, seq: int, *, saved: bool, urgent: bool) -> Position:
    """The position after an attempt to write a checkpoint of message `seq`.

    If the disk is full, an urgent checkpoint (the sender is blocked) is acknowledged although it is only in memory:
    training continues.

    >>> stored(Position(8), 12, saved=False, urgent=True).in_memory
    4
    """
    if not saved and not urgent:
        return position
    return replace(position, seq=seq, in_memory=0 if saved else seq - position.seq + position.in_memory)


def with_end(position: Position, seq: int) -> Position:
    """The position with the end of the stream, which contains no features: it counts as the message before it.

    >>> with_end(Position(8, 8, 2), 9) == Position(9, 9, 3)
    True
    """
    if seq <= position.seq:
        return position
    return replace(position, seq=seq, processed=seq, in_memory=position.in_memory and position.in_memory + 1)
