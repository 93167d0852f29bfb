"""The desired state of a detector, as set by commands; it is stored on disk for a restarted detector."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from catstream import storage
from catstream.box import Box
from catstream.errors import ProtocolError

__all__ = ["DesiredState"]


@dataclass(frozen=True, slots=True)
class DesiredState:
    """The state that a detector keeps until a command changes it.

    box      the object in its first frame; of about its size if a saved model searches for it; None before a box is set
    begins   seq of the message of that first frame, 0 if the object is found by a saved model
    paused   whether tracking is paused
    stopped  whether the stream is to end
    """

    box: Box | None = None
    begins: int = 0
    paused: bool = False
    stopped: bool = False

    @property
    def holds(self) -> bool:
        """Whether no frames are tracked: the run is paused, or waits for a box."""
        return self.paused or self.box is None

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
            return cls(**{**read, "box": read["box"] and Box(*read["box"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ProtocolError(
                f"the desired state cannot be read from {path} ({error!r}): the run starts with its original box, "
                "repeat later commands"
            ) from None
