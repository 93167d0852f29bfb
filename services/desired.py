"""The desired state of a detector: what its commands ask for, kept on disk for a detector that is started again."""

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
    """The state that holds until a command asks for another one.

    box      the object in its first frame; about its size if it is searched for; None while a box is waited for
    begins   seq of the message of that first frame, 0 if the object is found by a saved model
    paused   whether no frame is followed
    stopped  whether the stream ends at once
    """

    box: Box | None = None
    begins: int = 0
    paused: bool = False
    stopped: bool = False

    @property
    def holds(self) -> bool:
        """Whether no frame is followed now: the run is paused, or waits for a box."""
        return self.paused or self.box is None

    def save(self, path: Path) -> None:
        """Write it to a file atomically.

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
                f"what was commanded cannot be read from {path} ({error!r}): what the run was started with holds, "
                "command the rest again"
            ) from None
