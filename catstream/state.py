"""The state of a pipeline on disk: what it needs to go on after a power cut.

    DIR/origin.safetensors  what it was started with, for its owner alone: the source may have a password in it
    DIR/desired_state.json         what was commanded: see `catstream.services.commands`
    DIR/trees/              the compressor's checkpoints: see `catstream.compression.generations`

A pipeline holds DIR for itself, and its compressor DIR/trees: by locks of the kernel, which are
gone with the process that had them, however it ended.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from catstream import storage
from catstream.box import Box
from catstream.compression.generations import Generations
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.learned import Learned
from catstream.messages import Position
from catstream.settings import Settings
from catstream.threads import one_thread
from catstream.training.trainer import Trainer

__all__ = ["TREES", "Origin", "began", "learned", "locked", "position"]

#: Folder of the checkpoints, in that of the state.
TREES = "trees"

_FILE = "origin.safetensors"
_HELP = "give another folder"

#: Settings that change nothing of what is learned: a run may go on with others.
_FREE = {"run.endpoint", "run.keys", "run.lockstep", "run.lag_frames", "run.unstored_frames", "run.checkpoint_seconds"}


@dataclass(frozen=True, slots=True)
class Origin:
    """What a pipeline was started with.

    source    as `catstream.video.source.open_source` takes it, from any working directory
    box       of the object in the first frame, None where it was searched for, or waited for
    part      which frames of the source there are to follow
    settings  all of them
    size      width and height of the frames
    started   seconds since 1970
    notes     what whoever started it wants to know when it goes on: name -> text
    model     file of the model that it is searched for with, empty where there is none
    """

    source: str
    box: Box | None
    part: slice
    settings: Settings
    size: tuple[int, int]
    started: float
    notes: dict[str, str] = field(default_factory=dict)
    model: str = ""

    def save(self, folder: Path) -> None:
        """Begin the state in a folder that is locked; or change what it says, where it goes on.

        Raises
        ------
        ServiceError
            Where it cannot be written.
        """
        facts: dict[str, object] = {field.name: getattr(self, field.name) for field in fields(self)}
        facts |= {"part": [self.part.start, self.part.stop, self.part.step], "settings": self.settings.values()}
        try:
            storage.write(folder / _FILE, {}, facts, mode=0o600)
        except OSError as error:
            raise ServiceError(f"cannot keep the state in {str(folder)!r} ({error.strerror}): {_HELP}") from None

    @classmethod
    def load(cls, folder: Path) -> Origin:
        """Read what `save` wrote.

        Raises
        ------
        ServiceError
            Where there is nothing.
        ProtocolError, SettingsError
            Where it is damaged, or of another catstream.
        """
        if not (folder / _FILE).is_file():
            raise ServiceError(f"no pipeline was kept in {str(folder)!r}: start one with --state {folder}")
        facts: dict[str, Any] = storage.read(folder / _FILE)[1]
        try:
            made = {
                "box": facts["box"] and Box(*facts["box"]),
                "part": slice(*facts["part"]),
                "settings": Settings.of(facts["settings"]),
                "size": tuple(facts["size"]),
            }
            return cls(**(facts | made))
        except (KeyError, TypeError) as error:
            raise ProtocolError(f"{folder / _FILE} does not say how the pipeline was started ({error!r})") from None

    def check(self, folder: Path, other: Origin) -> None:
        """Raise SettingsError where what was learned here does not fit what would go on with it."""
        if other.size != self.size or other.part != self.part:
            raise SettingsError(
                f"what is kept in {str(folder)!r} is of {_frames(self)}, and this would be {_frames(other)}: "
                "go on with the same frames, or begin anew in another folder"
            )
        ours, theirs = self.settings.values(), other.settings.values()
        for name in sorted(ours.keys() - _FREE):
            if ours[name] != theirs[name]:
                raise SettingsError(
                    f"what is kept in {str(folder)!r} was learned with {name}={ours[name]}, not {theirs[name]}: "
                    "go on with the same settings (they are kept too: give none), or begin anew in another folder"
                )


def _frames(origin: Origin) -> str:
    part = ":".join(
        "" if number is None else str(number) for number in (origin.part.start, origin.part.stop, origin.part.step)
    )
    return f"{origin.size[0]}x{origin.size[1]} pixels, frames {part}"


def began(folder: Path) -> bool:
    """Whether a pipeline was started in this folder."""
    return (folder / _FILE).exists() or (folder / TREES).exists()


def position(folder: Path, settings: Settings) -> Position:
    """Where the newest whole checkpoint is."""
    return Generations(folder / TREES).load(settings).position


def learned(folder: Path, settings: Settings) -> Learned:
    """What was learned of the object, by the newest whole checkpoint: the sample in it gives its model once more.

    Raises
    ------
    ServiceError
        If there is no checkpoint, or nothing was learned before the newest one.
    """
    compressor = Generations(folder / TREES).load(settings)
    if compressor.last_sample is None or compressor.box is None or not compressor.sampled:
        raise ServiceError("nothing was learned of the object yet, so there is nothing to save")
    trainer = Trainer(settings)
    with one_thread():  # as the pipeline's own trainer: the model has the same bits
        model = trainer.train(compressor.last_sample)
    return Learned(model, compressor.last_sample, compressor.box)


@contextlib.contextmanager
def locked(folder: Path, seconds: float = 0.0) -> Iterator[Path]:
    """Lock a folder for this process alone; the folder is made if it does not exist.

    Parameters
    ----------
    seconds : how long to wait if another process has locked it

    Raises
    ------
    ServiceError
        If another process keeps it locked, or it cannot be made.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise ServiceError(f"cannot keep the state in {str(folder)!r} ({error.strerror}): {_HELP}") from None
    try:
        if not storage.lock(handle, seconds):
            raise ServiceError(f"a pipeline that runs keeps its state in {str(folder)!r}: stop it, or {_HELP}")
        yield folder
    finally:
        os.close(handle)
