"""Settings: every number that the paper and the design name, in groups, with its unit, default and bounds.

A setting has the name `group.name`, for example `coreset.size`. Values come, each overriding the one before, from the
defaults here, a preset, a TOML file (a table for each group), environment variables (`CATSTREAM_CORESET_SIZE=128`),
and the program or the command line (`--set coreset.size=128`).
"""

from __future__ import annotations

import dataclasses
import difflib
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
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_type_hints

import msgspec
from msgspec import Meta

from catstream.errors import CatstreamError, SettingsError

#: The value of a setting.
Value = str | int | float | bool


def _about(description: str, **bounds: float) -> Meta:
    meta: Meta = Meta(description=description, **bounds)  # type: ignore[call-overload]  # its overloads name the bounds
    return meta


@dataclass(frozen=True, kw_only=True)
class _Group:
    """A group of settings: it checks the names and the values that it is made of."""

    group: ClassVar[str]

    def __new__(cls, **values: object) -> Self:
        for name in values:
            _check_name(f"{cls.group}.{name}")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            object.__setattr__(self, each.name, _checked(f"{self.group}.{each.name}", getattr(self, each.name)))


@dataclass(frozen=True, kw_only=True)
class RunSettings(_Group):
    """How a pipeline runs: its endpoint, its pace, its seed, and how it reads the source."""

    group = "run"

    endpoint: Annotated[
        str,
        _about("Where the processes meet: a folder for ipc:// sockets (empty: a new private one), or tcp://HOST:PORT."),
    ] = ""
    keys: Annotated[
        str,
        _about("Folder of keys from `catstream keys new` (empty: none): then each client must be allowed."),
    ] = ""
    lockstep: Annotated[
        bool, _about("Make a run repeatable bit for bit: the detector waits for each model before it continues.")
    ] = False
    lag_frames: Annotated[
        int,
        _about("Frames of a file by which the detector may be ahead of learning (0: as lockstep).", ge=0, le=65536),
    ] = 25
    seed: Annotated[int, _about("Seed of all random numbers.", ge=0)] = 0
    image_rate: Annotated[
        float, _about("Frames per second of a folder or a pattern of images, and of a live demo.", ge=1e-9, le=1000)
    ] = 25.0
    open_seconds: Annotated[
        float, _about("Time-out for opening a camera or a stream, with its first frame.", ge=0.1, le=3600)
    ] = 10.0
    silent_seconds: Annotated[
        float, _about("Time without a frame after which a camera or a stream reconnects.", ge=0.1, le=3600)
    ] = 5.0
    poll_seconds: Annotated[
        float, _about("Time from one picture to the next at the http:// address of a still picture.", ge=0.01, le=3600)
    ] = 1.0
    hardware: Annotated[
        str,
        _about("Device that decodes video, by FFmpeg's name for its kind, as cuda or qsv (empty: the processor)."),
    ] = ""
    skip_damaged: Annotated[
        bool, _about("Continue after a damaged place in a video file. Without it, the run ends there.")
    ] = False
    resize: Annotated[
        bool,
        _about("Scale images of another size to that of the first one. Without it, the run ends at such an image."),
    ] = False
    unstored_frames: Annotated[
        int, _about("Features messages, up to 256 MiB, that may be sent and not yet stored.", ge=1, le=65536)
    ] = 256
    objects_most: Annotated[int, _about("Objects that a stream may have at most.", ge=1, le=64)] = 32
    checkpoint_seconds: Annotated[
        float, _about("Time between two checkpoints of the coreset trees, in seconds.", gt=0, le=3600)
    ] = 2.0


@dataclass(frozen=True, kw_only=True)
class CoresetSettings(_Group):
    """The coreset trees (paper, section "Coreset Tree")."""

    group = "coreset"

    size: Annotated[int, _about("n in the paper: rows of a node of a coreset tree.", ge=2, le=4096)] = 64
    share: Annotated[
        float, _about("n as a share of the video's frames, as in the paper (0: coreset.size is used).", ge=0, le=0.5)
    ] = 0.0
    reduction: Annotated[
        Literal["svd", "frequent-directions"],
        _about("How rows are reduced: by the tree of the paper (svd), or by one sketch of n rows, of constant size."),
    ] = "svd"
    sample_interval: Annotated[
        int,
        _about("Frames between two samples from which a model is trained; fewer while the trees are small.", ge=1),
    ] = 8


@dataclass(frozen=True, kw_only=True)
class SearchSettings(_Group):
    """The search for the object in a frame."""

    group = "search"

    mode: Annotated[
        Literal["local", "full"],
        _about(
            "Search around the predicted place, and the whole frame if the score is low (local); or each whole frame."
        ),
    ] = "local"
    context: Annotated[float, _about("Size of the window as a multiple of the object's box.", ge=1, le=4)] = 1.25
    area: Annotated[float, _about("Side of the local search area as a multiple of the window's.", ge=1.5, le=6)] = 2.5
    whole_interval: Annotated[
        int,
        _about(
            "Frames between two searches of the whole frame while the local score is between belief.weak_score and "
            "belief.confident_score, or the object is not trusted.",
            ge=1,
        ),
    ] = 10
    motion_frames: Annotated[
        int, _about("Frames in a block of centres from which EM learns the parameters of the Kalman filter.", ge=8)
    ] = 64


@dataclass(frozen=True, kw_only=True)
class BeliefSettings(_Group):
    """The thresholds of the score, which is about 0 on background and about 1 on the object."""

    group = "belief"

    weak_score: Annotated[
        float, _about("Score below which the object is lost: it is absent, and the whole frame is searched.")
    ] = 0.4
    confident_score: Annotated[
        float,
        _about(
            "Score from which a trusted object is learned from, and its size adapted. A lost object returns at this "
            "score."
        ),
    ] = 0.45
    trusted_score: Annotated[
        float, _about("Score from which an object that was found elsewhere in the frame is learned from again.")
    ] = 0.75
    jump_margin: Annotated[
        float, _about("Difference of score by which a window elsewhere in the frame must exceed the local one.")
    ] = 0.4
    sighting_similarity: Annotated[
        float,
        _about("Similarity to the object of a saved model that a window needs to be its first detection."),
    ] = 0.5


@dataclass(frozen=True, kw_only=True)
class FeatureSettings(_Group):
    """What a feature row holds beside HOG and colours."""

    group = "features"

    network: Annotated[
        str,
        _about("ONNX file of a network whose features are used, too (empty: none): see `catstream network prepare`."),
    ] = ""


@dataclass(frozen=True, kw_only=True)
class TeachingSettings(_Group):
    """Which training rows are cut from a frame, and how a model is learned from them."""

    group = "teaching"

    bootstrap: Annotated[
        Literal["copies", "scm"],
        _about(
            "Source of the first model: n affine copies of the first box (copies), or n boxes of the sparse "
            "collaborative model, as in the paper (scm)."
        ),
    ] = "copies"
    classifier: Annotated[
        Literal["joint", "least-squares", "one-class"],
        _about(
            "How a model is learned: least squares of the object's mean against the background, plus the regression of "
            "the loss tree (joint); the former alone (least-squares); or the paper's one-class SVM (one-class)."
        ),
    ] = "joint"
    colours: Annotated[bool, _about("Use the histogram of the window's colours as a feature.")] = True
    copies: Annotated[
        int, _about("Affine copies of the object in each frame (paper: 4 for n = 5 % of the video).", ge=0, le=64)
    ] = 3
    mirrored: Annotated[int, _about("How many of these copies are mirrored left to right.", ge=0)] = 1
    other_backgrounds: Annotated[
        float, _about("Share of the first frame's affine copies that are put on another background.", ge=0, le=1)
    ] = 0.9
    near_misses: Annotated[
        int, _about("Windows beside the object in each frame, with a label between 0 and 1.", ge=0, le=256)
    ] = 6
    hard_negatives: Annotated[
        int, _about("Background windows with the highest scores, from a search of the whole frame.", ge=0)
    ] = 10
    interval: Annotated[
        int, _about("Of so many frames that the model explains, one is taught (1: all).", ge=1, le=1024)
    ] = 2


@dataclass(frozen=True, kw_only=True)
class ExtentSettings(_Group):
    """Size and aspect ratio of the object."""

    group = "extent"

    size_count: Annotated[int, _about("Sizes that a search may try, an odd number.", ge=1, le=15)] = 7
    aspect_count: Annotated[
        int, _about("Aspect ratios that a search may try, an odd number (1: it never changes).", ge=1, le=15)
    ] = 5
    prior: Annotated[
        float, _about("Weight of (log f)^2, for a size or aspect ratio of f times that of the first box.", ge=0)
    ] = 0.5
    weight: Annotated[
        float,
        _about("Weight of the extent head beside the appearance score (0: size and aspect heads are off, too).", ge=0),
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a run, in groups, checked. Frozen: `but` makes a changed copy.

    Parameters
    ----------
    run, coreset, search, belief, features, teaching, extent : the group, or a mapping of its names to values
        What is left out has its default.

    Raises
    ------
    SettingsError
        For a name that does not exist (names the nearest), or a value that does not fit.

    Examples
    --------
    >>> Settings(coreset={"size": 128}).coreset.size
    128
    """

    run: RunSettings = field(default_factory=RunSettings)
    coreset: CoresetSettings = field(default_factory=CoresetSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    belief: BeliefSettings = field(default_factory=BeliefSettings)
    features: FeatureSettings = field(default_factory=FeatureSettings)
    teaching: TeachingSettings = field(default_factory=TeachingSettings)
    extent: ExtentSettings = field(default_factory=ExtentSettings)

    if TYPE_CHECKING:  # a group may be given as a mapping, and is read as a group

        def __init__(
            self,
            *,
            run: RunSettings | Mapping[str, object] = ...,
            coreset: CoresetSettings | Mapping[str, object] = ...,
            search: SearchSettings | Mapping[str, object] = ...,
            belief: BeliefSettings | Mapping[str, object] = ...,
            features: FeatureSettings | Mapping[str, object] = ...,
            teaching: TeachingSettings | Mapping[str, object] = ...,
            extent: ExtentSettings | Mapping[str, object] = ...,
        ) -> None: ...

    def __new__(cls, **groups: object) -> Self:
        for name in groups:
            if name not in _groups():
                _check_name(name)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name, group in _groups().items():
            value = getattr(self, name)
            if isinstance(value, Mapping):
                object.__setattr__(self, name, group(**value))
            elif not isinstance(value, group):
                raise SettingsError(
                    f"the group of settings {name} cannot be {reprlib.repr(value)}: give a {group.__name__}, or names "
                    f"and values, for example Settings({name}={{...}})"
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
        """Collect settings from all their sources: those that `given` finds, the others by default."""
        return cls.from_values(cls.collect(preset=preset, file=file, overrides=overrides, environment=environment))

    @staticmethod
    def collect(
        *,
        preset: str | None = None,
        file: str | os.PathLike[str] | None = None,
        overrides: Mapping[str, object] | Iterable[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> dict[str, object]:
        """Names and values that are set in some source, as `from_values` and `but` check them.

        Parameters
        ----------
        preset : str or None
            A name of `PRESETS`.
        file : path or None
            A TOML file with a table for each group.
        overrides : mapping of str, or iterable of str
            Names and values, or texts `group.name=value` as `--set` takes them.
        environment : mapping of str, or None
            Variables, `CATSTREAM_GROUP_NAME=value`; None for the process's own. Others with this prefix are left alone.

        Raises
        ------
        SettingsError
            For a preset that does not exist, a file that cannot be read, or a variable that is empty or of no setting.
        """
        values: dict[str, object] = {}
        if preset is not None:
            if preset not in PRESETS:
                raise SettingsError(f"there is no preset {preset!r}: there are {', '.join(PRESETS)}")
            values.update(PRESETS[preset])
        if file is not None:
            values.update(flat(read_toml(Path(file), SettingsError)))
        for variable, text in (os.environ if environment is None else environment).items():
            name = variable.removeprefix("CATSTREAM_").lower().replace("_", ".", 1)
            if variable.startswith("CATSTREAM_") and not _is_foreign(name):
                _check_name(name, variable)
                if not text:
                    raise SettingsError(f"the environment variable {variable} is empty: give it a value, or unset it")
                values[name] = text
        return values | _named(overrides)

    @classmethod
    def from_values(cls, values: Mapping[str, object]) -> Settings:
        """Check names and values, flat (`coreset.size`) or in groups; texts are read as their setting's type.

        Examples
        --------
        >>> Settings.from_values({"coreset.share": ".5", "run": {"lockstep": True}}).changed()
        ['run.lockstep=true', 'coreset.share=0.5']
        """
        groups: dict[str, dict[str, object]] = {}
        for name, value in flat(values).items():
            _check_name(name)
            group, _, short = name.partition(".")
            groups.setdefault(group, {})[short] = _read_text(name, value) if isinstance(value, str) else value
        return cls(**groups)

    def for_length(self, frames: int | None) -> Settings:
        """These settings for a video of so many frames: `coreset.share` becomes a `coreset.size`.

        SettingsError if there is a share and the length is not known.

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
                "is not known: set coreset.size instead"
            )
        return self.replace({"coreset.size": max(2, round(self.coreset.share * frames)), "coreset.share": 0.0})

    def replace(self, others: Mapping[str, object] | Iterable[str]) -> Settings:
        """A copy with some of them changed: names and values, or texts `group.name=value` as `--set` takes them.

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
        """Those that differ from their default, as `load` takes them.

        Examples
        --------
        >>> Settings(run={"lockstep": True}, coreset={"size": 32}).changed()
        ['run.lockstep=true', 'coreset.size=32']
        """
        default, texts = _defaults(), self.texts()
        return [f"{name}={texts[name]}" for name, value in self.values().items() if value != default[name]]

    def texts(self) -> dict[str, str]:
        """All values as texts, by full name; `from_values` reads them."""
        values = self.values().items()
        return {name: value if isinstance(value, str) else json.dumps(value) for name, value in values}

    def portable(self) -> dict[str, str]:
        """The texts of all settings but those that have a meaning on this machine only."""
        return {name: text for name, text in self.texts().items() if name not in _LOCAL}


_LOCAL = ("run.endpoint", "run.keys", "features.network")
_SERVICE = re.compile(r"(^|[._])(service[._](host|port)|port(_[0-9]+_(tcp|udp).*)?$|port\.[0-9]+_(tcp|udp))")

_PAPER: dict[str, Value] = {
    "teaching.classifier": "one-class",
    "search.mode": "full",
    "teaching.bootstrap": "scm",
    "extent.weight": 0.0,
    "extent.prior": 0.0,
    "teaching.colours": False,
    "teaching.other_backgrounds": 0.0,
    "teaching.mirrored": 0,
    "teaching.interval": 1,
    "belief.weak_score": 0.3,
    "belief.trusted_score": 0.0,
}

#: Settings of the paper, by name. Frames and copies together make 25 % of a video: 1.5 copies a frame at 10 %.
PRESETS: dict[str, dict[str, Value]] = {
    "one-class-paper": _PAPER | {"teaching.copies": 4},
    "cat10": _PAPER | {"coreset.share": 0.10, "teaching.copies": 1},
    "cat25": _PAPER | {"coreset.share": 0.25, "teaching.copies": 0},
}


def describe() -> list[tuple[str, str, Value, str]]:
    """Full name, type, default and meaning of every setting: for `--help` and the docs."""
    default = _defaults()
    return [(name, _takes(name), default[name], kind.__metadata__[0].description) for name, kind in _kinds().items()]


@cache
def _groups() -> dict[str, type[_Group]]:
    """Name and class of each group."""
    return get_type_hints(Settings)


@cache
def _kinds() -> dict[str, Any]:
    """Type and bounds of each setting, by its full name."""
    hints = {name: get_type_hints(group, include_extras=True) for name, group in _groups().items()}
    return {f"{name}.{each}": kind for name, kinds in hints.items() for each, kind in kinds.items() if each != "group"}


@cache
def _defaults() -> dict[str, Value]:
    """Default of each setting, by its full name."""
    return Settings().values()


def flat(values: Mapping[str, object]) -> dict[str, object]:
    """Values by full name, from values by full name or in groups."""
    found: dict[str, object] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{short}": each for short, each in value.items()}
        else:
            found[name] = value
    return found


def _takes(name: str) -> str:
    """The valid values of a setting: its type or options, and its bounds."""
    kind, meta = _kinds()[name].__origin__, _kinds()[name].__metadata__[0]
    bounds = [
        f"{sign} {value:g}"
        for sign, value in ((">=", meta.ge), (">", meta.gt), ("<=", meta.le), ("<", meta.lt))
        if value is not None
    ]
    options = getattr(kind, "__args__", None)
    text = " | ".join(map(str, options)) if options else kind.__name__
    return " ".join([text, ", ".join(bounds)]).strip()


def _check_name(name: str, variable: str = "") -> None:
    """Raise SettingsError for the name of no setting; `variable` is that of the environment which gives it, if any."""
    if name not in _kinds():
        near = [repr(other) for other in _nearest(name)]
        meant = f", did you mean {' or '.join(near)}?" if near else ":"
        origin = f" for the environment variable {variable}" if variable else ""
        raise SettingsError(
            f"there is no setting {name!r}{origin}{meant} `catstream settings` lists all {len(_kinds())}"
        )


def _is_foreign(name: str) -> bool:
    """Whether a variable with our prefix, as the name of a setting, is for something else.

    It is of no group and like no setting; or an orchestrator has made it for a service that is called catstream.
    """
    if _SERVICE.search(name):
        return True
    return name.partition(".")[0] not in _groups() and not _nearest(name)


def _nearest(name: str) -> list[str]:
    """Full names that are similar, or that end as the name does."""
    similar = difflib.get_close_matches(name.replace("_", "."), _kinds(), n=3)
    return similar or [full for full in _kinds() if full.partition(".")[2] == name]


def _checked(name: str, value: object) -> object:
    """The value of a setting, of its type; a scalar of numpy is a value of Python."""
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        value = value.item()
    try:
        checked = msgspec.convert(value, _kinds()[name])
    except (UnicodeEncodeError, msgspec.ValidationError):  # a byte of the command line that is not UTF-8
        raise _misfit(name, value) from None
    if isinstance(checked, float) and not math.isfinite(checked):
        raise _misfit(name, value)
    return checked


def _read_text(name: str, text: str) -> object:
    """The value that a text means, of the type of its setting."""
    kind = _kinds()[name].__origin__
    try:
        if kind is bool:
            return msgspec.convert(text, bool, strict=False)
        return kind(text) if kind in (int, float) else text
    except (ValueError, msgspec.ValidationError):
        raise _misfit(name, text) from None


def _misfit(name: str, value: object) -> SettingsError:
    return SettingsError(f"setting {name} cannot be {reprlib.repr(value)}: it takes {_takes(name)}")


def _named(given: Mapping[str, object] | Iterable[str]) -> dict[str, object]:
    return dict(given if isinstance(given, Mapping) else map(_pair, given))


def _pair(text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not (sign and value.strip()):
        raise SettingsError(f"a setting is given as group.name=value, got {text!r}")
    return name.strip(), value.strip()


def read_toml(path: Path, kind: type[CatstreamError]) -> dict[str, object]:
    """The tables of a TOML file; raises an error of this kind if it cannot be read, or is none."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise kind(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # not UTF-8, not TOML, or nested without end
        raise kind(f"{path}: this is not TOML: {error}") from None
