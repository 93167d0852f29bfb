"""The last two checkpoints of a compressor, a file each: if the newest is damaged, the one before it is used."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from catstream.base.settings import Settings
from catstream.compression.forest import Forest
from catstream.errors import ProtocolError

_KEPT = 2
_DAMAGED = "damaged"  # name of the newest damaged checkpoint, which is kept for analysis

Read = TypeVar("Read")

_log = logging.getLogger(__name__)


class CheckpointStore:
    """A folder with the newest two checkpoints, and one that was found damaged; `trouble` says what is wrong now.

    A checkpoint is written atomically, and is on disk before `save` returns. No file is overwritten: an older
    checkpoint is removed after a newer one is complete.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._folder = Path(folder)
        self._damaged: list[Path] = []
        self._found_damaged = ""  # description of the damaged files
        self._not_written = ""  # description of why the last checkpoint could not be written

    @property
    def trouble(self) -> str:
        return "; ".join(filter(None, (self._not_written, self._found_damaged)))

    def load(self, settings: Settings) -> Forest:
        """A forest from the newest undamaged checkpoint, a new one if there is none.

        ServiceError if that file is not a checkpoint, or one of another version of catstream; SettingsError if it was
        made with another coreset size.
        """
        forest = self._newest(lambda path: Forest.load(path, settings))
        if self._damaged:
            instead = f"the one of frame {forest.frame} was used" if forest else "everything is learned again"
            self._found_damaged = f"damaged checkpoints: {len(self._damaged)}, {instead}"
            _log.warning("%s", self._found_damaged)
        return forest or Forest(settings)

    def position(self) -> tuple[int, float]:
        """Number of the newest message in the newest undamaged checkpoint, and time of its frame; 0 if there is none.

        ServiceError as of `load`.
        """
        return self._newest(Forest.position_in) or (0, 0.0)

    def _newest(self, read: Callable[[Path], Read]) -> Read | None:
        """The newest checkpoint that is not damaged, as `read` returns it; None if there is none."""
        self._damaged = []
        for path in reversed(self._files()):
            try:
                return read(path)
            except (ProtocolError, OSError) as error:
                _log.warning("a checkpoint cannot be used: %s", error)
                self._damaged.append(path)
        return None

    def save(self, forest: Forest) -> bool:
        """Write a checkpoint, and remove the oldest; returns False and changes nothing if it cannot be written."""
        files = self._files()
        number = int(files[-1].stem) + 1 if files else 1
        try:
            forest.save(self._folder / f"{number:012d}.safetensors")
        except OSError as error:
            why = f"no checkpoint can be written to {self._folder} ({error.strerror})"
            if why != self._not_written:
                _log.warning("%s: what is learned is kept in memory only, and it is tried again", why)
            self._not_written = why
            return False
        if self._not_written:
            _log.warning("checkpoints are written again")
        self._not_written = ""
        for path in self._damaged:
            path.replace(self._folder / _DAMAGED)
        self._damaged = []
        for path in self._files()[:-_KEPT]:
            path.unlink()
        return True

    def _files(self) -> list[Path]:
        """The checkpoints, oldest first."""
        return sorted(self._folder.glob("[0-9]*.safetensors"))
