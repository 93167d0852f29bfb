"""The job of a run: its source, objects, settings and files.

The program that starts a run writes its job to a file, which every process of the run reads. A run with a state folder
is resumed from a copy of the job in that folder.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from shlex import quote
from typing import Any, get_type_hints

import msgspec

from catstream.base.box import Box
from catstream.base.files import writing
from catstream.base.names import UNNAMED, Boxes, boxes_by_name, by_name, check_count
from catstream.base.settings import RESUMABLE, Settings
from catstream.base.text import listed
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.wire import storage

#: Files of saved models: of one object without a name, or by name.
Models = str | os.PathLike[str] | Mapping[str, str | os.PathLike[str]]

#: Name of the file of a job, in its folder.
JOB = "job.safetensors"

_ALL = slice(None)  # frames


@dataclass(frozen=True, slots=True)
class Results:
    """The files that `catstream track` writes for a run; a resumed run continues the same files.

    None means no file in a new run, and an unchanged value in a resumed run.

    output      folder of the results files
    video       whether an annotated video is among the results files
    write       further files of tracks, see `catstream.output.destinations`
    models      file for the model of each object, by name; an unnamed file is for the only object
    rotate      when the files of a live source are rotated, see `catstream.output.options.parse_rotation`
    keep        maximum number of rotated files of each kind
    """

    output: Path | None = None
    video: bool | None = None
    write: tuple[Path, ...] | None = None
    models: dict[str, Path] = field(default_factory=dict)
    rotate: str | None = None
    keep: int | None = None

    def after(self, earlier: Results) -> Results:
        """The files of the earlier part of the run, updated with these where they are set."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(earlier, **{name: value for name, value in values.items() if value not in (None, {})})


@dataclass(frozen=True, slots=True)
class Job:
    """The configuration that all processes of a run share.

    source    argument of `catstream.video.source.open_source`
    boxes     initial boxes of the objects, by name; without a box or a model, the run waits for a command with a box
    models    saved model (`catstream save`) of each searched object, by name
    part      tracked frames of the source
    settings  all settings
    size      width and height of a frame, None if unknown
    rate      frames per second, None if unknown
    results   files that `catstream track` writes
    paused    whether the run starts paused, until the command `resume`

    The other fields are for one start of the run, and are not in the stored copy:

    endpoint  endpoint of the processes; the setting of the same name if this is empty
    state     folder of the checkpoints and of the desired state; None to store nothing
    resume    whether the processes continue from that state
    run       id of this start of the run, which its messages carry; the program that started it receives all tracks on
              the channel `results`. Empty if the processes were started manually
    since     value of `time.monotonic` at time 0 of a live source; None for its first frame
    first     number of its last frame before this start: for a live source, the newest checkpoint may be older
    """

    source: str = field(default="", repr=False)  # it may contain a password
    boxes: dict[str, Box] = field(default_factory=dict)
    models: dict[str, Path] = field(default_factory=dict)
    part: slice = field(default_factory=lambda: _ALL)
    settings: Settings = field(default_factory=Settings)
    size: tuple[int, int] | None = None
    rate: float | None = None
    results: Results = Results()
    paused: bool = False
    endpoint: str = ""
    state: Path | None = None
    resume: bool = False
    run: str = ""
    since: float | None = None
    first: int = 0

    def __post_init__(self) -> None:
        if both := self.boxes.keys() & self.models.keys():
            raise SettingsError(
                f"box and model of {listed(sorted(both))} are mutually exclusive (start at a position / search for it)"
            )
        check_count(len(self.boxes) + len(self.models), self.settings.run.max_objects)

    @classmethod
    def new(
        cls,
        source: str | None,
        boxes: Boxes | None = None,
        settings: Settings | Mapping[str, object] | None = None,
        *,
        models: Models | None = None,
        part: slice = _ALL,
        results: Results | None = None,
        paused: bool = False,
    ) -> Job:
        """The job of a new run, with the arguments of `catstream.Pipeline`; SettingsError without a source."""
        if not source:
            raise SettingsError("missing source: a new run needs a video, a folder of images, a camera or a stream")
        return cls(
            source=source,
            boxes={} if boxes is None else boxes_by_name(boxes),
            models={name: file.absolute() for name, file in files_by_name(models).items()},
            part=part,
            settings=Settings().replace(settings),
            results=results or Results(),
            paused=paused,
        )

    def resumed(
        self,
        source: str | None = None,
        settings: Settings | Mapping[str, object] | None = None,
        *,
        part: slice = _ALL,
        results: Results | None = None,
        paused: bool = False,
    ) -> Job:
        """The job of the next part of the run, with the arguments that are not None."""
        return replace(
            self,
            source=self.source if source is None else source,
            part=self.part if part == _ALL else part,
            settings=self.settings.replace(settings),
            results=self.results if results is None else results.after(self.results),
            paused=paused,
        )

    def save(self, folder: Path) -> Path:
        """Write the job to a private file in a folder, because the source may contain a password; returns its path.

        ServiceError if it cannot be written.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        metadata = msgspec.to_builtins(values | {"settings": self.settings.values()}, enc_hook=_plain)
        with writing(folder):
            storage.write(folder / JOB, {}, metadata)
        return folder / JOB

    @classmethod
    def load(cls, path: Path) -> Job:
        """Read the job from the file that `save` wrote, or from its folder.

        ServiceError if the file does not exist; ProtocolError or SettingsError if it is damaged, or was written by
        another version of catstream.
        """
        file = path / JOB if path.is_dir() else path
        if not file.is_file():
            raise ServiceError(f"{str(path)!r} contains no run: start one with --state {quote(str(path))}")
        metadata: dict[str, Any] = storage.read(file)[1]
        try:
            settings = Settings.from_values(metadata.pop("settings"))
            read = {name: msgspec.convert(metadata[name], kind, dec_hook=_typed) for name, kind in _kinds().items()}
            return cls(**read, settings=settings)
        except (AttributeError, KeyError, TypeError, msgspec.ValidationError) as error:
            raise ProtocolError(f"{file} is not a valid job of a pipeline ({error!r})") from None

    def source_frame(self, frame: int) -> int:
        """The number in the source of a tracked frame.

        >>> Job(part=slice(100, None, 2)).source_frame(3)
        106
        """
        return (self.part.start or 0) + frame * (self.part.step or 1)

    def check_fits(self, other: Job, folder: Path) -> None:
        """Raise SettingsError if another job cannot continue this one; its state is in `folder`."""
        if other._frames() != self._frames():
            raise SettingsError(
                f"the run in {str(folder)!r} has {self._frames()}, not {other._frames()}: "
                "continue with the same frames, or start a new run in another folder"
            )
        if changed := changed_setting(self.settings, other.settings):
            raise SettingsError(
                f"the run in {str(folder)!r} was started with {changed}: omit the settings, which are stored, or start "
                "a new run in another folder"
            )

    def _frames(self) -> str:
        """Description of the size and the numbers of the frames, for an error."""
        size = "" if self.size is None else f"{self.size[0]}x{self.size[1]} pixels, "
        first, stop, stride = self.part.start or 0, self.part.stop, self.part.step or 1
        numbers = f"frames {first} to {'the last' if stop is None else stop - 1}"
        return f"{size}{numbers}{f' in steps of {stride}' * (stride > 1)}"


def changed_setting(before: Settings, after: Settings) -> str:
    """The first setting that differs and is not `RESUMABLE`, with both values; empty if there is none.

    >>> changed_setting(Settings(), Settings(coreset={"size": 32}, run={"lag_frames": 25}))
    'coreset.size=64, not 32'
    """
    ours, theirs = before.values(), after.values()
    changed = (name for name in sorted(ours.keys() - RESUMABLE) if ours[name] != theirs[name])
    return next((f"{name}={ours[name]}, not {theirs[name]}" for name in changed), "")


def files_by_name(files: Models | None) -> dict[str, Path]:
    """Paths by object name; an unnamed file is for the only object."""
    named = files if isinstance(files, Mapping) else {} if files is None else {UNNAMED: files}
    return {name: Path(file) for name, file in by_name(named).items()}


def _plain(value: object) -> object:
    """Convert a value of a type that `msgspec` does not support to JSON."""
    if isinstance(value, slice):
        return [None if number is None else int(number) for number in (value.start, value.stop, value.step)]
    return str(value)


def _typed(kind: type, value: Any) -> object:
    """The reverse of `_plain`."""
    return slice(*value) if kind is slice else kind(value)


@cache
def _kinds() -> dict[str, Any]:
    """The types of the fields of a job by name, without its settings, which `Settings` checks."""
    return {name: kind for name, kind in get_type_hints(Job).items() if name != "settings"}
