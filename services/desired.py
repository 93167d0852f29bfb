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

__all__ = ["DesiredObject", "DesiredState"]


@dataclass(frozen=True, slots=True)
class DesiredObject:
    """An object that is to be followed.

    box     the object in its first frame; of about its size if a saved model searches for it
    begins  seq of the message of that first frame, 0 if the object is found by a saved model
    since   seq of the first message that has a track of this name; lower than `begins` if another object had the name
    """

    box: Box
    begins: int = 0
    since: int = 0


@dataclass(frozen=True, slots=True)
class DesiredState:
    """The state that a detector keeps until a command changes it.

    objects  the objects by name; none before a box is set
    paused   whether tracking is paused
    stopped  whether the stream is to end
    """

    objects: dict[str, DesiredObject] = field(default_factory=dict)
    paused: bool = False
    stopped: bool = False

    @property
    def holds(self) -> bool:
        """Whether no frames are tracked: the run is paused, or waits for a box."""
        return self.paused or not self.objects

    def begun(self, name: str, box: Box, seq: int) -> DesiredState:
        """The state after an object has begun, in the place of another one of its name."""
        since = self.objects[name].since if name in self.objects else seq
        return replace(self, objects=self.objects | {name: DesiredObject(box, seq, since)})

    def without(self, name: str) -> DesiredState:
        """The state after an object was forgotten."""
        return replace(self, objects={other: each for other, each in self.objects.items() if other != name})

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
                check_name(name): DesiredObject(Box(*each["box"]), each["begins"], each["since"])
                for name, each in read["objects"].items()
            }
            return cls(objects, bool(read["paused"]), bool(read["stopped"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ProtocolError(
                f"the desired state cannot be read from {path} ({error!r}): the run starts with its original boxes, "
                "repeat later commands"
            ) from None
