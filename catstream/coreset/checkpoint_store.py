"""The last checkpoints of a compressor, one file each: if the newest is damaged, an earlier one is used."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from catstream.base.files import REMEDIES, sync
from catstream.base.settings import Settings
from catstream.coreset.forest import Forest
from catstream.errors import ProtocolError

_CHECKPOINTS = 2  # number of checkpoints in the folder
_DAMAGED = "damaged"  # name of the newest damaged checkpoint, for analysis

Read = TypeVar("Read")

_log = logging.getLogger(__name__)


class CheckpointStore:
    """A folder with the newest two checkpoints, the newest durable one, and the last damaged one.

    A checkpoint is written atomically. A durable one is on disk before `save` returns. The others survive `kill -9`,
    but not a power failure: the kernel writes a file to disk after about 30 s, and they are removed earlier. No file is
    overwritten: an older checkpoint is removed after a newer one is complete. If the disk is full, the older ones are
    removed before, but never the newest valid one.

    size           bytes of the newest checkpoint that this store has written
    write_problem  why the last checkpoint could not be written; empty if it was, None before the first one
    trouble        current problems
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._folder = Path(folder)
        self._durable: Path | None = None  # the newest that this store has written
        self.size = 0
        self._damaged: list[Path] = []
        self._read_problem = ""  # why checkpoints were not used
        self.write_problem: str | None = None

    @property
    def trouble(self) -> str:
        return "; ".join(filter(None, (self.write_problem, self._read_problem)))

    def load(self, settings: Settings) -> Forest:
        """A forest from the newest undamaged checkpoint, a new one if there is none.

        ServiceError if that file is not a checkpoint, or one of another version of catstream; SettingsError if it was
        made with another coreset size.
        """
        forest = self._newest(lambda path: Forest.load(path, settings))
        if self._damaged:
            consequence = f"the checkpoint of frame {forest.frame} was used" if forest else "training starts again"
            self._read_problem = f"damaged checkpoints: {len(self._damaged)}; {consequence}"
            _log.warning("%s", self._read_problem)
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

    def save(self, forest: Forest, *, durable: bool = True) -> bool:
        """Write a checkpoint, and remove the oldest; returns False and changes nothing if it cannot be written."""
        files = self._files()
        number = int(files[-1].stem) + 1 if files else 1
        path = self._folder / f"{number:012d}.safetensors"
        try:
            forest.save(path, durable=durable)
            self.size = path.stat().st_size
        except OSError as error:
            # On a full disk, remove the least valuable checkpoint, and try again.
            by_value = sorted(files, key=lambda file: file not in self._damaged)  # damaged ones first, then by age
            if error.errno in (errno.ENOSPC, errno.EDQUOT) and len(by_value) > 1:
                with suppress(OSError):
                    sync(by_value[-1])  # otherwise, a power failure might leave no checkpoint
                    by_value[0].unlink()
                    self._durable = by_value[-1]
                    self._damaged = [file for file in self._damaged if file != by_value[0]]
                    return self.save(forest, durable=durable)
            remedy = REMEDIES.get(error.errno or 0, "make the folder writable")
            problem = f"cannot write checkpoints to {self._folder} ({error.strerror}): {remedy}"
            if problem != self.write_problem:
                _log.warning("%s; training rows are in memory only", problem)
            self.write_problem = problem
            return False
        if self.write_problem:
            _log.warning("checkpoints are written again")
        self.write_problem = ""
        # Keep the newest damaged checkpoint for analysis, and remove those that are older than the newest two.
        for damaged in self._damaged:
            damaged.replace(self._folder / _DAMAGED)
        self._damaged = []
        self._durable = path if durable else self._durable
        for old in self._files()[:-_CHECKPOINTS]:
            if old != self._durable:
                old.unlink()
        return True

    def _files(self) -> list[Path]:
        """The checkpoints, oldest first."""
        return sorted(self._folder.glob("[0-9]*.safetensors"))
