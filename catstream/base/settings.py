"""Settings: every number that the paper and the design name, in groups, with its unit, default and bounds.

A setting has the name `group.name`, for example `coreset.size`. Values come, each overriding the one before, from the
defaults here, a preset, a TOML file (a table for each group), environment variables (`CATSTREAM_CORESET_SIZE=128`),
and the program or the command line (`--set coreset.size=128`).
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import json
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_args, get_type_hints

import msgspec
from msgspec import Meta

from catstream.errors import CatstreamError, SettingsError

#: The value of a setting.
Value = str | int | float | bool


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A row of the list of settings.

    name       full name
    type       of the value: a type of Python, or a Literal
    default    value
    about      meaning, and when to change it; the latter is missing if `expert`
    bounds     ge, gt, le and lt of the value
    expert     whether it is for experiments and the presets of the paper
    resumable  whether a resumed run may change it, because it does not affect the training
    local      whether its value has a meaning on this machine only
    """

    name: str = ""
    type: Any = str
    default: Value
    about: str = ""
    bounds: Mapping[str, float]
    expert: bool = False
    resumable: bool = False
    local: bool = False

    @property
    def takes(self) -> str:
        """The valid values: the type or the options, and the bounds.

        >>> describe()["coreset.size"].takes
        'int >= 2, <= 4096'
        """
        signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
        bounds = ", ".join(f"{signs[bound]} {value:g}" for bound, value in self.bounds.items())
        return " ".join([" | ".join(get_args(self.type)) or self.type.__name__, bounds]).strip()

    def check(self, value: object) -> Value:
        """Return a value in the type of the setting; SettingsError if it is not valid. A numpy scalar is converted."""
        if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
            value = value.item()
        try:
            checked: Value = msgspec.convert(value, Annotated[self.type, Meta(**self.bounds)])  # type: ignore[call-overload]
        except (UnicodeEncodeError, msgspec.ValidationError):  # a byte of the command line that is not UTF-8
            raise self._invalid(value) from None
        if isinstance(checked, float) and not math.isfinite(checked):
            raise self._invalid(value)
        return checked

    def parse(self, text: str) -> object:
        """Return the value of a text, in which numbers are written as in Python."""
        try:
            if self.type is bool:
                return msgspec.convert(text, bool, strict=False)
            return self.type(text) if self.type in (int, float) else text
        except (ValueError, msgspec.ValidationError):
            raise self._invalid(text) from None

    def _invalid(self, value: object) -> SettingsError:
        return SettingsError(f"setting {self.name} cannot be {reprlib.repr(value)}: it takes {self.takes}")


def _setting(
    default: Value, *, expert: bool = False, resumable: bool = False, local: bool = False, **bounds: float
) -> Any:
    """Declare a setting of a group: see `Setting`. The docstring of the group describes it."""
    setting = Setting(default=default, bounds=bounds, expert=expert, resumable=resumable, local=local)
    return field(default=default, metadata={"setting": setting})


@dataclass(frozen=True, kw_only=True)
class _Group:
    """A group of settings, which checks names and values. Its docstring has a row for each of them."""

    group: ClassVar[str]

    def __new__(cls, **values: object) -> Self:
        for name in values:
            _find(f"{cls.group}.{name}")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, _find(f"{self.group}.{name}").check(value))


@dataclass(frozen=True, kw_only=True)
class RunSettings(_Group):
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

    group = "run"

    endpoint: str = _setting("", resumable=True, local=True)
    keys: str = _setting("", resumable=True, local=True)
    lockstep: bool = _setting(False, resumable=True)
    lag_frames: int = _setting(25, ge=0, le=65536, resumable=True)
    seed: int = _setting(0, ge=0)
    image_rate: float = _setting(25.0, ge=1e-9, le=1000)
    open_timeout_seconds: float = _setting(10.0, ge=0.1, le=3600, resumable=True)
    read_timeout_seconds: float = _setting(5.0, ge=0.1, le=3600, resumable=True)
    hwaccel: str = _setting("")
    skip_damaged: bool = _setting(False)
    resize: bool = _setting(False)
    unstored_frames: int = _setting(256, ge=1, le=65536, resumable=True)
    max_objects: int = _setting(32, ge=1, le=64)
    checkpoint_seconds: float = _setting(2.0, gt=0, le=3600, resumable=True)


@dataclass(frozen=True, kw_only=True)
class CoresetSettings(_Group):
    """The coreset trees (paper, section "Coreset Tree").

    size             n in the paper: rows of a node of a coreset tree. Raise it for an object with many appearances;
                     time and memory grow with it.
    share            n as a share of the video's frames, as in the paper (0: coreset.size is used).
    """

    group = "coreset"

    size: int = _setting(64, ge=2, le=4096)
    share: float = _setting(0.0, ge=0, le=0.5, expert=True)


@dataclass(frozen=True, kw_only=True)
class SearchSettings(_Group):
    """The search for the object in a frame.

    mode           Search near the predicted position, and in the whole frame if the score is low (local); or always in
                   the whole frame, as in the paper (full).
    area           Side of the local search area as a multiple of the window's. Raise it for fast objects; time grows
                   with its square.
    full_interval  Frames between two searches of the whole frame while the local score is between belief.weak_score and
                   belief.confident_score, or the object is not trusted. Lower it for objects that jump, raise it to
                   save time.
    """

    group = "search"

    mode: Literal["local", "full"] = _setting("local", expert=True)
    area: float = _setting(2.5, ge=1.5, le=6)
    full_interval: int = _setting(10, ge=1)


@dataclass(frozen=True, kw_only=True)
class BeliefSettings(_Group):
    """The thresholds of the score, which is about 0 on background and about 1 on the object.

    weak_score          Score below which the object is absent, and the whole frame is searched. Raise it if absence is
                        reported too rarely, lower it if too often.
    confident_score     Score at which a lost object returns, and a trusted object is used for training and changes its
                        size. Raise it if a lost object returns at the wrong position.
    trusted_score       Score from which an object that was redetected elsewhere is used for training again. Raise it if
                        the model learns similar objects.
    """

    group = "belief"

    weak_score: float = _setting(0.4)
    confident_score: float = _setting(0.45)
    trusted_score: float = _setting(0.75)


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(_Group):
    """The training rows of a frame, and how a model is trained on them.

    bootstrap          Source of the first model: n affine copies of the initial box (copies), or n boxes of the sparse
                       collaborative model, as in the paper (scm).
    classifier         Classifier: the linear discriminant of object and background plus the regression of the loss tree
                       (joint); the former alone (least-squares); or the paper's one-class SVM (one-class).
    colours            Use the histogram of the window's colours as a feature. Turn it off if the light changes its
                       colour.
    copies             Affine copies of the object in each frame (paper: 4 for n = 5 % of the video). Raise it for an
                       object that rotates or is seen in few frames.
    augment            Flip a copy in each frame left to right, and put most copies of the first frame on another
                       background. Turn it off if the object never turns or its background never changes.
    hard_negatives     Background windows with the highest scores, from a search of the whole frame. Raise it if the
                       tracker switches to similar objects.
    interval           Train on one of this number of frames whose score is high (1: on all). Raise it for speed, lower
                       it for an object that changes quickly.
    """

    group = "training"

    bootstrap: Literal["copies", "scm"] = _setting("copies", expert=True)
    classifier: Literal["joint", "least-squares", "one-class"] = _setting("joint", expert=True)
    colours: bool = _setting(True)
    copies: int = _setting(3, ge=0, le=64)
    augment: bool = _setting(True)
    hard_negatives: int = _setting(10, ge=0)
    interval: int = _setting(2, ge=1, le=1024)


@dataclass(frozen=True, kw_only=True)
class ExtentSettings(_Group):
    """Size and aspect ratio of the object.

    size_count    Sizes that a search may try, an odd number. Raise it for an object that changes its size quickly; 1
                  keeps the size.
    learned     Learn the size and the aspect ratio from windows of wrong ones, and prefer those of the initial box.
                Turn it off for more speed if the object keeps its shape.
    """

    group = "extent"

    size_count: int = _setting(7, ge=1, le=15)
    learned: bool = _setting(True)


@dataclass(frozen=True, kw_only=True)
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

    run: RunSettings = field(default_factory=RunSettings)
    coreset: CoresetSettings = field(default_factory=CoresetSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    belief: BeliefSettings = field(default_factory=BeliefSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    extent: ExtentSettings = field(default_factory=ExtentSettings)

    if TYPE_CHECKING:  # a mapping is converted to its group

        def __init__(
            self,
            *,
            run: RunSettings | Mapping[str, object] = ...,
            coreset: CoresetSettings | Mapping[str, object] = ...,
            search: SearchSettings | Mapping[str, object] = ...,
            belief: BeliefSettings | Mapping[str, object] = ...,
            training: TrainingSettings | Mapping[str, object] = ...,
            extent: ExtentSettings | Mapping[str, object] = ...,
        ) -> None: ...

    def __new__(cls, **groups: object) -> Self:
        for name in groups:
            if name not in _groups():
                _find(name)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name, group in _groups().items():
            value = getattr(self, name)
            if isinstance(value, Mapping):
                object.__setattr__(self, name, group(**value))
            elif not isinstance(value, group):
                raise SettingsError(
                    f"the group of settings {name} cannot be {reprlib.repr(value)}: pass a {group.__name__} or a "
                    f"mapping of names to values, Settings({name}={{...}})"
                )

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
        """Collect the names and values that are set in some source, unchecked, for `from_values` or `replace`.

        Parameters
        ----------
        preset : str or None
            A name of `PRESETS`.
        file : path or None
            A TOML file with a table for each group.
        overrides : mapping of str, or iterable of str
            Names and values, or texts `group.name=value` as `--set` takes them.
        environment : mapping of str, or None
            Variables, `CATSTREAM_GROUP_NAME=value`; None for `os.environ`. Others with this prefix are ignored.

        Raises
        ------
        SettingsError
            For an unknown preset, a file that cannot be read, or a variable that is empty or of no setting.
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
            if variable.startswith("CATSTREAM_") and not _is_foreign(name):
                _find(name, variable)
                if not text:
                    raise SettingsError(f"the environment variable {variable} is empty: set a value, or unset it")
                values[name] = text
        return values | _named(overrides)

    @classmethod
    def from_values(cls, values: Mapping[str, object]) -> Settings:
        """Check names and values, by full name (`coreset.size`) or in groups; texts are parsed.

        Examples
        --------
        >>> Settings.from_values({"coreset.share": ".5", "run": {"lockstep": True}}).changed()
        ['run.lockstep=true', 'coreset.share=0.5']
        """
        groups: dict[str, dict[str, object]] = {}
        for name, value in flat(values).items():
            setting = _find(name)
            group, _, short = name.partition(".")
            groups.setdefault(group, {})[short] = setting.parse(value) if isinstance(value, str) else value
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

    def replace(self, others: Mapping[str, object] | Iterable[str]) -> Settings:
        """Return a copy with other values, by name, or as texts `group.name=value` in the form of `--set`.

        Examples
        --------
        >>> Settings(run={"lockstep": True}).replace(["coreset.size=32"]).changed()
        ['run.lockstep=true', 'coreset.size=32']
        """
        return Settings.from_values(self.values() | flat(_named(others)))

    def values(self) -> dict[str, Value]:
        """All values, by full name."""
        groups = dataclasses.asdict(self).items()
        return {f"{group}.{name}": value for group, values in groups for name, value in values.items()}

    def changed(self) -> list[str]:
        """Texts `group.name=value` of the settings that differ from their default.

        Examples
        --------
        >>> Settings(run={"lockstep": True}, coreset={"size": 32}).changed()
        ['run.lockstep=true', 'coreset.size=32']
        """
        texts, settings = self.texts(), describe()
        return [f"{name}={texts[name]}" for name, value in self.values().items() if value != settings[name].default]

    def texts(self) -> dict[str, str]:
        """All values as texts, by full name, for `from_values`."""
        values = self.values().items()
        return {name: value if isinstance(value, str) else json.dumps(value) for name, value in values}

    def portable(self) -> dict[str, str]:
        """The texts of all settings except those with a meaning on this machine only."""
        settings = describe()
        return {name: text for name, text in self.texts().items() if not settings[name].local}


_SERVICE = re.compile(r"(^|[._])(service[._](host|port)|port(_[0-9]+_(tcp|udp).*)?$|port\.[0-9]+_(tcp|udp))")

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


@cache
def describe() -> dict[str, Setting]:
    """All settings by full name: for `--help` and the docs."""
    settings: dict[str, Setting] = {}
    for group, kind in _groups().items():
        types = get_type_hints(kind)
        rows = re.findall(r"^(\w+) {2,}(.+(?:\n {2,}.+)*)", inspect.cleandoc(kind.__doc__ or ""), re.MULTILINE)
        texts = {name: " ".join(text.split()) for name, text in rows}
        for entry in dataclasses.fields(kind):
            settings[f"{group}.{entry.name}"] = dataclasses.replace(
                entry.metadata["setting"],
                name=f"{group}.{entry.name}",
                type=types[entry.name],
                about=texts.get(entry.name, ""),
            )
    return settings


@cache
def _groups() -> dict[str, type[_Group]]:
    """Name and class of each group."""
    return get_type_hints(Settings)


def flat(values: Mapping[str, object]) -> dict[str, object]:
    """Values by full name, from values by full name or in groups."""
    flattened: dict[str, object] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flattened |= {f"{name}.{short}": entry for short, entry in value.items()}
        else:
            flattened[name] = value
    return flattened


def _find(name: str, variable: str = "") -> Setting:
    """Return the setting of a name, which came from an environment variable if one is named.

    SettingsError, with the nearest names, if there is none.
    """
    if name in describe():
        return describe()[name]
    near = [repr(other) for other in _nearest(name)]
    suggestion = f", did you mean {' or '.join(near)}?" if near else ":"
    origin = f" for the environment variable {variable}" if variable else ""
    raise SettingsError(
        f"there is no setting {name!r}{origin}{suggestion} `catstream settings` lists all {len(describe())}"
    )


def _is_foreign(name: str) -> bool:
    """Return True if a variable with our prefix is no setting: its name is similar to none, or that of an orchestrator.

    Kubernetes sets CATSTREAM_SERVICE_HOST and others for a service named catstream.
    """
    if _SERVICE.search(name):
        return True
    return name.partition(".")[0] not in _groups() and not _nearest(name)


def _nearest(name: str) -> list[str]:
    """Full names that are similar, or that have this name in their group."""
    similar = difflib.get_close_matches(name.replace("_", "."), describe(), n=3)
    return similar or [full for full in describe() if full.partition(".")[2] == name]


def _named(values: Mapping[str, object] | Iterable[str]) -> dict[str, object]:
    return dict(values if isinstance(values, Mapping) else map(_pair, values))


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
    except (ValueError, RecursionError) as error:  # not UTF-8, not TOML, or nested without end
        raise kind(f"{path}: this is not TOML: {error}") from None
