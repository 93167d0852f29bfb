"""The desired state of a detector, as set by commands; it is stored on disk for a restarted detector."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Self

from catstream import storage
from catstream.box import Box
from catstream.errors import ProtocolError
from catstream.names import check_name

__all__ = ["DesiredObject", "DesiredState", "PastObject"]

_PAST = 256  # far more than there are in the frames that a restarted detector repeats


@dataclass(frozen=True, slots=True)
class DesiredObject:
    """An object that is to be followed.

    box     the object in its first frame; of about its size if a saved model searches for it
    begins  seq of the message of that first frame, 0 if the object is found by a saved model
    """

    box: Box
    begins: int = 0


@dataclass(frozen=True, slots=True)
class PastObject:
    """An object that was forgotten, or replaced by another one of its name.

    A restarted detector may have to repeat its last frames. It does not search for the object again, but each of these
    frames has a track of it.

    first, last  seq of the first and of the last message with a track of it
    """

    name: str
    first: int
    last: int


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

    def begun(self, name: str, box: Box, seq: int) -> DesiredState:
        """The state after an object has begun in message `seq`, in the place of another one of its name."""
        before = self.without(name, seq - 1) if name in self.objects else self
        return replace(before, objects=self.objects | {name: DesiredObject(box, seq)})

    def without(self, name: str, last: int) -> DesiredState:
        """The state after an object was forgotten; message `last` is the last one with a track of it."""
        past = self.past
        if (first := max(self.objects[name].begins, 1)) <= last:
            past = (*past, PastObject(name, first, last))[-_PAST:]
        objects = {other: each for other, each in self.objects.items() if other != name}
        return replace(self, objects=objects, past=past)

    def past_names(self, seq: int) -> list[str]:
        """The names of the earlier objects of which message `seq` has a track."""
        return [each.name for each in self.past if each.first <= seq <= each.last]

    def save(self, path: Path) -> None:
        """Write the state to a file atomically.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        storage.write_atomically(path, json.dumps(asdict(self)).encode())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        ProtocolError
            If the file cannot be read.
        """
        try:
            read = json.loads(path.read_text())
            objects = {
                check_name(name): DesiredObject(Box(*each["box"]), int(each["begins"]))
                for name, each in read["objects"].items()
            }
            past = (
                PastObject(check_name(each["name"]), int(each["first"]), int(each["last"])) for each in read["past"]
            )
            return cls(objects, tuple(past), bool(read["paused"]), bool(read["stopped"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ProtocolError(
                f"the desired state cannot be read from {path} ({error!r}): the run starts with its original boxes, "
                "repeat later commands"
            ) from None
