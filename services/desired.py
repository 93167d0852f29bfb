"""The desired state of a detector, as set by commands; it is stored on disk for a restarted detector."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import msgspec

from catstream.box import Box
from catstream.errors import ProtocolError
from catstream.messages import storage

#: Name of the file, in the folder of the state.
DESIRED = "desired_state.json"

_PAST = 256  # far more than there are in the frames that a restarted detector repeats


@dataclass(frozen=True, slots=True)
class DesiredObject:
    """An object that is to be followed.

    box     the object in its first frame; the last box in the saved model if the object begins with one
    begins  seq of the message of its first frame
    model   name of the saved model that it begins with, see `catstream.services.model_files`; empty if it has none
    size    bytes of the saved model
    """

    box: Box
    begins: int
    model: str = ""
    size: int = 0


@dataclass(frozen=True, slots=True)
class PastObject:
    """An object that was forgotten, or replaced by another one of its name: a restarted detector may repeat its frames.

    name   its name
    each   its first box, and the message in which it began
    last   seq of the last message with a track of it
    place  its place among the objects then
    """

    name: str
    each: DesiredObject
    last: int
    place: int = 0


@dataclass(frozen=True, slots=True)
class DesiredState:
    """The state that a detector keeps until a command changes it.

    objects  the objects by name; none before a box is set
    past     the objects before them, oldest first; the last 256
    paused   whether tracking is paused
    stopped  whether the stream is to end
    """

    objects: dict[str, DesiredObject] = field(default_factory=dict)
    past: tuple[PastObject, ...] = ()
    paused: bool = False
    stopped: bool = False

    @property
    def holds(self) -> bool:
        """Whether no frames are tracked: the run is paused, or waits for a box."""
        return self.paused or not self.objects

    def begun(self, name: str, each: DesiredObject) -> DesiredState:
        """The state after an object has begun, in the place of another one of its name."""
        before = self.without(name, each.begins - 1) if name in self.objects else self
        return replace(before, objects=before.objects | {name: each})

    def without(self, name: str, last: int) -> DesiredState:
        """The state after an object was forgotten; message `last` is the last one that may have a track of it."""
        each, place = self.objects[name], [*self.objects].index(name)
        past = (*self.past, PastObject(name, each, last, place))[-_PAST:] if each.begins <= last else self.past
        objects = {other: its for other, its in self.objects.items() if other != name}
        return replace(self, objects=objects, past=past)

    def objects_at(self, seq: int) -> dict[str, DesiredObject]:
        """The objects of which message `seq` has a track, by name, in the order in which they began."""
        objects = [PastObject(name, each, seq) for name, each in self.objects.items()]
        for was in reversed(self.past):
            objects.insert(was.place, was)
        return {was.name: was.each for was in objects if was.each.begins <= seq <= was.last}

    def models_since(self, seq: int) -> set[str]:
        """The names of the saved models that the objects of message `seq`, or of a later one, begin with."""
        past = (was.each for was in self.past if was.last >= seq)
        return {each.model for each in (*self.objects.values(), *past)} - {""}

    def save(self, path: Path) -> None:
        """Write the state to a file atomically.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        storage.write_atomically(path, msgspec.json.encode(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        ProtocolError
            If the file cannot be read.
        """
        try:
            return msgspec.json.decode(path.read_bytes(), type=cls)
        except (OSError, msgspec.DecodeError) as error:
            raise ProtocolError(
                f"the desired state cannot be read from {path} ({error!r}): the run starts with its original boxes, "
                "repeat later commands"
            ) from None
