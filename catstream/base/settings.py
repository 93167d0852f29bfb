"""Settings: every number that the paper and the design name, in groups, with its unit, default and bounds.

A setting has the name `group.name`, for example `coreset.size`. Values come, each overriding the one before, from the
defaults here, a preset, a TOML file (a table for each group), environment variables (`CATSTREAM_CORESET_SIZE=128`),
and the program or the command line (`--set coreset.size=128`).
"""

from __future__ import annotations

import difflib
import inspect
import json
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

from catstream.errors import CatstreamError, SettingsError

#: The value of a setting.
Value = str | int | float | bool

_Rate = Annotated[float, Meta(ge=1e-9, le=1000)]
_Timeout = Annotated[float, Meta(ge=0.1, le=3600)]


class _Group(Struct, frozen=True, kw_only=True):
    """A group of settings with validated values. The docstring of a subclass has a row for each setting."""

    def __post_init__(self) -> None:
        group = next(name for name, kind in _groups().items() if isinstance(self, kind))
        for name in self.__struct_fields__:
            value = describe()[f"{group}.{name}"].check(getattr(self, name))
            msgspec.structs.force_setattr(self, name, value)

    def replace(self, **values: object) -> Self:
        """Return a copy with other values."""
        return msgspec.structs.replace(self, **values)


class RunSettings(_Group, frozen=True, kw_only=True):
    """How a pipeline runs: its endpoint, its pace, its seed, and how it reads the source.

    endpoint              Address of the processes: a folder for ipc:// sockets (empty: a new private one), or
                          tcp://HOST:PORT. Set it to attach to a run by a fixed address, or from other machines.
    keys                  Folder of keys from `catstream keys new` (empty: no authentication). Required if other
                          machines can reach the endpoint.
    lockstep              The detector waits for each model before it continues. Turn it on for a run that is repeatable
                          bit for bit.
    lag_frames            Frames of a file by which the detector may be ahead of training (0: as lockstep). Lower it for
                          more accuracy, raise it for more speed.
    seed                  Seed of all random numbers. Change it to measure the variance of a result over several runs.
    image_rate            Frames per second of a folder of images, and of a live demo. Set it to the rate at which the
                          images were taken.
    open_timeout_seconds  Timeout for connecting to a camera or a stream, with its first frame. Raise it for a camera
                          that starts slowly.
    read_timeout_seconds  Time without a frame after which a camera or a stream reconnects. Raise it if the camera sends
                          a frame less often.
    hwaccel               Hardware decoder of video, by FFmpeg's name, for example cuda or qsv (empty: none). Set it if
                          decoding takes a large part of the processor time.
    skip_damaged          Skip damaged parts of a video file. Turn it on if a run ends with an error at such a part.
    resize                Scale images of another size to the size of the first one. Turn it on for a folder of images
                          of several sizes.
    unstored_frames       Features messages, up to 256 MiB, that may be sent and not yet stored. Raise it if a slow disk
                          holds up the detector.
    max_objects           Maximum number of objects of a stream. Raise it to track more of them at once.
    checkpoint_seconds    Time between two checkpoints of the coreset trees. Raise it to write less to the disk, lower
                          it to lose fewer training rows of a live source in a crash.
    """

    endpoint: str = ""
    keys: str = ""
    lockstep: bool = False
    lag_frames: Annotated[int, Meta(ge=0, le=65536)] = 25
    seed: Annotated[int, Meta(ge=0)] = 0
    image_rate: _Rate = 25.0
    open_timeout_seconds: _Timeout = 10.0
    read_timeout_seconds: _Timeout = 5.0
    hwaccel: str = ""
    skip_damaged: bool = False
    resize: bool = False
    unstored_frames: Annotated[int, Meta(ge=1, le=65536)] = 256
    max_objects: Annotated[int, Meta(ge=1, le=64)] = 32
    checkpoint_seconds: Annotated[float, Meta(gt=0, le=3600)] = 2.0


class CoresetSettings(_Group, frozen=True, kw_only=True):
    """The coreset trees (paper, section "Coreset Tree").

    size   n in the paper: rows of a node of a coreset tree. Raise it for an object with many appearances; time and
           memory grow with it.
    share  n as a share of the video's frames (0: coreset.size is used). Set by the presets cat10 and cat25.
    """

    size: Annotated[int, Meta(ge=2, le=4096)] = 64
    share: Annotated[float, Meta(ge=0, le=0.5)] = 0.0


class SearchSettings(_Group, frozen=True, kw_only=True):
    """The search for the object in a frame.

    mode           Search near the predicted position, and in the whole frame if the score is low (local); or always in
                   the whole frame (full). Set by the presets of the paper.
    area           Side of the local search area as a multiple of the window's. Raise it for fast objects; time grows
                   with its square.
    full_interval  Frames between two searches of the whole frame while the local score is between belief.weak_score and
                   belief.confident_score, or the object is not trusted. Lower it for objects that jump, raise it to
                   save time.
    """

    mode: Literal["local", "full"] = "local"
    area: Annotated[float, Meta(ge=1.5, le=6)] = 2.5
    full_interval: Annotated[int, Meta(ge=1)] = 10


class BeliefSettings(_Group, frozen=True, kw_only=True):
    """The thresholds of the score, which is about 0 on background and about 1 on the object.

    weak_score          Score below which the object is absent, and the whole frame is searched. Raise it if absence is
                        reported too rarely, lower it if too often.
    confident_score     Score at which a lost object returns, and a trusted object is used for training and changes its
                        size. Raise it if a lost object returns at the wrong position.
    trusted_score       Score from which an object that was redetected elsewhere is used for training again. Raise it if
                        the model learns similar objects.
    """

    weak_score: float = 0.4
    confident_score: float = 0.45
    trusted_score: float = 0.75


class TrainingSettings(_Group, frozen=True, kw_only=True):
    """The training rows of a frame, and how a model is trained on them.

    bootstrap       Source of the first model: n affine copies of the initial box (copies), or n boxes of the sparse
                    collaborative model (scm). Set by the presets of the paper.
    classifier      Classifier: the linear discriminant of object and background plus the regression of the loss tree
                    (joint); the former alone (least-squares); or a one-class SVM (one-class). Set by the presets of the
                    paper.
    colours         Use the histogram of the window's colours as a feature. Turn it off if the light changes its colour.
    copies          Affine copies of the object in each frame (paper: 4 for n = 5 % of the video). Raise it for an
                    object that rotates or is seen in few frames.
    augment         Mirror a copy in each frame, and put most copies of the first frame on another background. Turned
                    off by the presets of the paper.
    hard_negatives  Background windows with the highest scores, from a search of the whole frame. Raise it if the
                    tracker switches to similar objects.
    interval        Train on one of this number of frames whose score is high (1: on all). Raise it for speed, lower it
                    for an object that changes quickly.
    """

    bootstrap: Literal["copies", "scm"] = "copies"
    classifier: Literal["joint", "least-squares", "one-class"] = "joint"
    colours: bool = True
    copies: Annotated[int, Meta(ge=0, le=64)] = 3
    augment: bool = True
    hard_negatives: Annotated[int, Meta(ge=0)] = 10
    interval: Annotated[int, Meta(ge=1, le=1024)] = 2


class ExtentSettings(_Group, frozen=True, kw_only=True):
    """Size and aspect ratio of the object.

    size_count  Number of sizes that a search may try. Raise it for an object that changes its size quickly; 1 keeps the
                size.
    learned     Learn size and aspect ratio from windows of wrong sizes and shapes; prefer those of the initial box.
                Turn it off for more speed if the object keeps its shape.
    """

    size_count: Literal[1, 3, 5, 7, 9, 11, 13, 15] = 7
    learned: bool = True


@dataclass(frozen=True, init=False)
class Settings:
    """All settings of a run, in groups, checked. Frozen: `replace` returns a changed copy.

    Parameters
    ----------
    run, coreset, search, belief, training, extent : the group, or a mapping of its names to values
        Defaults apply to the rest.

    Raises
    ------
    SettingsError
        For an unknown name (with the nearest ones), or an invalid value.

    Examples
    --------
    >>> Settings(coreset={"size": 128}).coreset.size
    128
    """

    run: RunSettings
    coreset: CoresetSettings
    search: SearchSettings
    belief: BeliefSettings
    training: TrainingSettings
    extent: ExtentSettings

    def __init__(self, **groups: Any) -> None:
        for name in groups.keys() - _groups().keys():
            _check_name(name)
        for name, kind in _groups().items():
            group = groups.get(name, {})
            if not isinstance(group, kind):
                for short in group:
                    _check_name(f"{name}.{short}")
                group = kind(**group)
            object.__setattr__(self, name, group)

    @classmethod
    def load(
        cls,
        *,
        preset: str | None = None,
        file: str | os.PathLike[str] | None = None,
        overrides: Mapping[str, object] | Iterable[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> Settings:
        """Load settings from all their sources: see `collect`; defaults apply to the rest."""
        return cls.from_values(cls.collect(preset=preset, file=file, overrides=overrides, environment=environment))

    @staticmethod
    def collect(
        *,
        preset: str | None = None,
        file: str | os.PathLike[str] | None = None,
        overrides: Mapping[str, object] | Iterable[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> dict[str, object]:
        """Collect the values that are set in any source, unchecked, for `from_values` or `replace`.

        Parameters
        ----------
        preset : str or None
            A name of `PRESETS`.
        file : path or None
            A TOML file with a table for each group.
        overrides : mapping of str, or iterable of str
            Names and values, or texts `group.name=value` as for `--set`.
        environment : mapping of str, or None
            Variables, `CATSTREAM_GROUP_NAME=value`; None for `os.environ`. Unrelated ones are ignored.

        Raises
        ------
        SettingsError
            For an unknown preset, a file that cannot be read, or an empty or unknown variable.
        """
        values: dict[str, object] = {}
        if preset is not None:
            if preset not in PRESETS:
                raise SettingsError(f"there is no preset {preset!r}: choose one of {', '.join(PRESETS)}")
            values.update(PRESETS[preset])
        if file is not None:
            values.update(flat(read_toml(Path(file), SettingsError)))
        for variable, text in (os.environ if environment is None else environment).items():
            name = variable.removeprefix("CATSTREAM_").lower().replace("_", ".", 1)
            # Ignore variables that resemble no setting: Kubernetes sets CATSTREAM_SERVICE_HOST.
            if variable.startswith("CATSTREAM_") and (name in describe() or _nearest(name)):
                _check_name(name, f" for the environment variable {variable}")
                if not text:
                    raise SettingsError(f"the environment variable {variable} is empty: set a value, or unset it")
                values[name] = text
        return values | (flat(overrides) if isinstance(overrides, Mapping) else dict(map(_pair, overrides)))

    @classmethod
    def from_values(cls, values: Mapping[str, object]) -> Settings:
        """Make settings from names and values, by full name (`coreset.size`) or in groups; defaults for the rest.

        Examples
        --------
        >>> Settings.from_values({"coreset.share": ".5", "run": {"lockstep": True}}).changed()
        ['run.lockstep=true', 'coreset.share=0.5']
        """
        groups: dict[str, dict[str, object]] = {}
        for name, value in flat(values).items():
            _check_name(name)
            group, _, short = name.partition(".")
            groups.setdefault(group, {})[short] = value
        return cls(**groups)

    def for_length(self, frames: int | None) -> Settings:
        """Compute `coreset.size` from `coreset.share`, for a video with this number of frames.

        SettingsError if there is a share and the length is unknown.

        Examples
        --------
        >>> Settings(coreset={"share": 0.1}).for_length(945).coreset.size
        94
        """
        if not self.coreset.share:
            return self
        if frames is None:
            raise SettingsError(
                f"coreset.share={self.coreset.share:g} is a share of the video's length, and the length of this source "
                "is unknown: set coreset.size instead"
            )
        return self.replace({"coreset.size": max(2, round(self.coreset.share * frames)), "coreset.share": 0.0})

    def replace(self, others: Settings | Mapping[str, object] | None) -> Settings:
        """Return a copy with changed values, as for `from_values`; another `Settings` replaces all of them.

        Examples
        --------
        >>> Settings(run={"lockstep": True}).replace({"coreset.size": 32}).changed()
        ['run.lockstep=true', 'coreset.size=32']
        """
        return others if isinstance(others, Settings) else Settings.from_values(self.values() | flat(others or {}))

    def values(self) -> dict[str, Value]:
        """All values, by full name."""
        groups = {group: msgspec.structs.asdict(getattr(self, group)) for group in _groups()}
        return {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}

    def changed(self) -> list[str]:
        """Texts `group.name=value` of the settings that differ from their default."""
        changed = {name: value for name, value in self.values().items() if value != describe()[name].default}
        return [f"{name}={value if isinstance(value, str) else json.dumps(value)}" for name, value in changed.items()]


#: Settings that a resumed run may change, because they do not affect the training.
RESUMABLE = {
    *("run.endpoint", "run.keys", "run.lockstep", "run.lag_frames", "run.unstored_frames", "run.checkpoint_seconds"),
    *("run.open_timeout_seconds", "run.read_timeout_seconds"),
}

_PAPER: dict[str, Value] = {
    "training.classifier": "one-class",
    "search.mode": "full",
    "training.bootstrap": "scm",
    "extent.learned": False,
    "training.colours": False,
    "training.augment": False,
    "training.interval": 1,
    "belief.weak_score": 0.3,
    "belief.trusted_score": 0.0,
}

#: Settings of the paper, by name of the preset. Frames and copies make 25 % of a video: 1.5 copies a frame at 10 %.
PRESETS: dict[str, dict[str, Value]] = {
    "one-class-paper": _PAPER | {"training.copies": 4},
    "cat10": _PAPER | {"coreset.share": 0.10, "training.copies": 1},
    "cat25": _PAPER | {"coreset.share": 0.25, "training.copies": 0},
}


@dataclass(frozen=True)
class Setting:
    """A row of the list of settings.

    name     full name
    type     a type of Python or a Literal, possibly annotated with bounds
    default  default value
    about    meaning, and when to change it
    """

    name: str
    type: Any
    default: Value
    about: str

    @property
    def takes(self) -> str:
        """The valid values: the type or the options, and the bounds.

        >>> describe()["coreset.size"].takes
        'int >= 2, <= 4096'
        """
        kind, *bounds = get_args(self.type) if get_origin(self.type) is Annotated else (self.type,)
        signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
        limits = [
            f"{sign} {limit:g}"
            for meta in bounds
            for bound, sign in signs.items()
            if (limit := getattr(meta, bound)) is not None
        ]
        return " ".join([" | ".join(map(str, get_args(kind))) or kind.__name__, ", ".join(limits)]).strip()

    def check(self, value: object) -> Value:
        """Convert a value or a text to the type of the setting; SettingsError if it is not valid."""
        original = value
        if getattr(value, "ndim", None) == 0:  # a number of numpy
            value = value.item()  # type: ignore[attr-defined]
        try:
            if isinstance(value, str) and isinstance(self.default, int | float) and not isinstance(self.default, bool):
                value = type(self.default)(value)  # ".5" and "007" are valid in Python, not in JSON
            checked: Value = msgspec.convert(value, self.type, strict=not isinstance(value, str))
            if not isinstance(checked, float) or math.isfinite(checked):
                return checked
        except (ValueError, msgspec.ValidationError):  # ValueError: also for text that is not UTF-8
            pass
        raise SettingsError(f"setting {self.name} cannot be {reprlib.repr(original)}: expected {self.takes}")


@cache
def describe() -> dict[str, Setting]:
    """All settings by full name: for `--help` and the docs."""
    settings: dict[str, Setting] = {}
    for group, kind in _groups().items():
        types = get_type_hints(kind, include_extras=True)
        rows = re.findall(r"^(\w+) {2,}(.+(?:\n {2,}.+)*)", inspect.cleandoc(kind.__doc__ or ""), re.MULTILINE)
        texts = {name: " ".join(text.split()) for name, text in rows}
        for field in msgspec.structs.fields(kind):
            name = f"{group}.{field.name}"
            settings[name] = Setting(name, types[field.name], field.default, texts.get(field.name, ""))
    return settings


@cache
def _groups() -> dict[str, type[_Group]]:
    """Name and class of each group."""
    return get_type_hints(Settings)


def flat(values: Mapping[str, object]) -> dict[str, object]:
    """Flatten values in groups to values by full name."""
    flattened: dict[str, object] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flattened |= {f"{name}.{short}": entry for short, entry in value.items()}
        else:
            flattened[name] = value
    return flattened


def _check_name(name: str, origin: str = "") -> None:
    """Raise SettingsError, with the nearest names, if there is no setting of this name; the error mentions `origin`."""
    if name not in describe():
        near = " or ".join(map(repr, _nearest(name)))
        suggestion = f", did you mean {near}?" if near else ":"
        raise SettingsError(
            f"there is no setting {name!r}{origin}{suggestion} `catstream settings` lists all {len(describe())}"
        )


def _nearest(name: str) -> list[str]:
    """Full names that are similar, or that have this name in their group."""
    similar = difflib.get_close_matches(name.replace("_", "."), describe(), n=3)
    return similar or [full for full in describe() if full.partition(".")[2] == name]


def _pair(text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not (sign and value.strip()):
        raise SettingsError(f"{text!r} is not a setting: expected group.name=value")
    return name.strip(), value.strip()


def read_toml(path: Path, kind: type[CatstreamError]) -> dict[str, object]:
    """Read the tables of a TOML file; raises an error of this kind if it cannot be read or parsed."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise kind(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # not UTF-8, not TOML, or nested too deeply
        raise kind(f"{path}: this is not TOML: {error}") from None
