"""The last checkpoints of a compressor, each a file: where the newest is damaged, there is one before it."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from catstream.compression.compressor import Compressor
from catstream.errors import ProtocolError
from catstream.settings import Settings

__all__ = ["CheckpointStore"]

_KEPT = 2
_DAMAGED = "damaged"  # the newest of these is kept, for whoever wants to know why

_log = logging.getLogger(__name__)


class CheckpointStore:
    """Checkpoints in a folder: the newest `_KEPT`, one that was found damaged, and nothing else.

    A file appears there whole or not at all, and is on disk before the call returns. None is
    written over: what is there stays until a newer one is whole.

    Parameters
    ----------
    folder : of the checkpoints, and of nothing else

    Attributes
    ----------
    trouble : what is wrong now, for a person; empty where nothing is
    failing : whether the last checkpoint could not be written
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.failing = False
        self._folder = Path(folder)
        self._damaged: list[Path] = []
        self._said = ""  # of damaged files
        self._why = ""  # the last checkpoint could not be written

    @property
    def trouble(self) -> str:
        return "; ".join(filter(None, (self._why, self._said)))

    def load(self, settings: Settings) -> Compressor:
        """A compressor that goes on from the newest checkpoint that is whole; a new one where there is none.

        Raises
        ------
        SettingsError
            Where they were made with another coreset size.
        """
        self._damaged, compressor = [], None
        for path in reversed(self._files()):
            try:
                compressor = Compressor.load(path, settings)
                break
            except (ProtocolError, OSError) as error:
                _log.warning("a checkpoint cannot be used: %s", error)
                self._damaged.append(path)
        if self._damaged:
            instead = f"the one of frame {compressor.frame} was used" if compressor else "all is learned anew"
            self._said = f"damaged checkpoints: {len(self._damaged)}, {instead}"
            _log.warning("%s", self._said)
        return compressor or Compressor(settings)

    def save(self, compressor: Compressor) -> bool:
        """Write the next one, and remove the oldest; False where it cannot be written, and all stays as it was."""
        files = self._files()
        number = int(files[-1].stem) + 1 if files else 1
        try:
            compressor.save(self._folder / f"{number:012d}.safetensors")
        except OSError as error:
            why = f"no checkpoint can be written to {self._folder} ({error.strerror})"
            if why != self._why:
                _log.warning("%s: what is learned is kept in memory only, and it is tried again", why)
            self.failing, self._why = True, why
            return False
        if self.failing:
            _log.warning("checkpoints are written again")
        self.failing, self._why = False, ""
        for path in self._damaged:
            path.replace(self._folder / _DAMAGED)
        self._damaged = []
        for path in self._files()[:-_KEPT]:
            path.unlink()
        return True

    def _files(self) -> list[Path]:
        """Oldest first."""
        return sorted(self._folder.glob("[0-9]*.safetensors"))
