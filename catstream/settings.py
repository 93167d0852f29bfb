"""Settings: every number that the paper and the design name, with its unit, default and bounds.

Values come, each over the one before, from the defaults here, a preset, a TOML
file, environment variables (`CATSTREAM_CORESET_SIZE=128`), and what the program
or the command line sets (`--set coreset_size=128`).
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import reprlib
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from numbers import Number
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
from msgspec import Meta

from catstream.errors import SettingsError

__all__ = ["PRESETS", "Settings", "describe"]


def _about(description: str, **bounds: float) -> Meta:
    return Meta(description=description, **bounds)  # type: ignore[call-overload]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a run, checked. Frozen: `dataclasses.replace` makes a changed copy.

    Raises
    ------
    SettingsError
        For a name that does not exist (names the nearest), or a value that does not fit.

    Examples
    --------
    >>> Settings(coreset_size=128).coreset_size
    128
    """

    # --- running -------------------------------------------------------------------------------
    endpoint: Annotated[
        str,
        _about(
            "Where the processes meet: a folder for ipc:// sockets (empty: a fresh private one), "
            "or tcp://HOST:PORT, the first of the ports that the channels take."
        ),
    ] = ""
    keys: Annotated[
        str,
        _about(
            "Folder of keys from `catstream keys new` (empty: none): with it all is encrypted, who connects must be "
            "allowed, and others may reach the endpoint."
        ),
    ] = ""
    lockstep: Annotated[
        bool,
        _about("Repeat a run bit for bit: the detector waits for each model before it goes on."),
    ] = False
    lag_frames: Annotated[
        int,
        _about(
            "Frames of a file that the detector may be ahead of learning: it waits for the model to which "
            "the frame so long ago led (0: as lockstep).",
            ge=0,
            le=65536,
        ),
    ] = 25
    seed: Annotated[int, _about("Seed of everything random.", ge=0)] = 0
    image_rate: Annotated[
        float,
        _about(
            "Frames per second of a folder or a pattern of images, which have no clock of their own.", gt=0, le=1000
        ),
    ] = 25.0
    skip_damaged: Annotated[
        bool,
        _about(
            "Read a video file on after a damaged place: frames that cannot be decoded are left out and counted. "
            "Without it, the run ends there."
        ),
    ] = False
    window: Annotated[
        int,
        _about("Features messages that may be sent and not yet stored.", ge=1, le=65536),
    ] = 256
    checkpoint_seconds: Annotated[
        float,
        _about("Time between two checkpoints of the coreset trees, in seconds.", gt=0, le=3600),
    ] = 1.0

    # --- the coreset trees (paper, "Coreset Tree") -----------------------------------------------
    coreset_size: Annotated[int, _about("n: rows of a node of a coreset tree.", ge=2, le=4096)] = 64
    coreset_share: Annotated[
        float, _about("n as a share of the video's frames, as the paper sets it (0: coreset_size holds).", ge=0, le=0.5)
    ] = 0.0
    train_frames: Annotated[
        int,
        _about(
            "Frames between two samples that the trainer learns from; fewer where the trees grew by an eighth.",
            ge=1,
        ),
    ] = 5

    bootstrap: Annotated[
        Literal["copies", "scm"],
        _about(
            "What the first model is learned from: n affine copies of the first box (copies), or the boxes of the "
            "sparse collaborative model, which follows the object until there are n, as in the paper (scm)."
        ),
    ] = "copies"

    # --- training --------------------------------------------------------------------------------
    classifier: Annotated[
        Literal["joint", "least-squares", "one-class"],
        _about(
            "How a model is learned: least squares of the two trees, joined with that of the loss tree (joint), "
            "of the two trees alone (least-squares), or the paper's one-class linear SVM (one-class)."
        ),
    ] = "joint"
    ridge: Annotated[float, _about("Lambda of the least squares of the two trees.", gt=0)] = 1.0
    loss_ridge: Annotated[float, _about("Lambda of the least squares of the loss tree.", gt=0)] = 0.1
    extent_ridge: Annotated[float, _about("Lambda of the least squares of the extent tree.", gt=0)] = 0.1
    motion_frames: Annotated[
        int, _about("Frames in a block of centres, from which the Kalman filter's parameters are learned.", ge=8)
    ] = 64

    # --- detection ---------------------------------------------------------------------------------
    detection: Annotated[
        Literal["local", "full"],
        _about("Search around the object and the whole frame when unsure (local), or all of every frame (full)."),
    ] = "local"

    colours: Annotated[bool, _about("Learn which colours the object has, wherever in it they are.")] = True
    context: Annotated[float, _about("Size of the window as a multiple of the object's box.", ge=1, le=4)] = 1.25
    search_area: Annotated[float, _about("Side of the local search as a multiple of the window's.", ge=1.5, le=6)] = 2.5
    scale_count: Annotated[int, _about("Sizes that a search may try, an odd number.", ge=1, le=15)] = 7
    scale_step: Annotated[float, _about("Change of size from one to the next.", gt=0, le=0.5)] = 0.04
    scale_rate: Annotated[float, _about("Share of a change of size that is followed at once.", ge=0, le=1)] = 0.7
    aspect_count: Annotated[
        int,
        _about("Ratios of width to height that a search may try, an odd number (1: it never changes).", ge=1, le=15),
    ] = 5
    aspect_step: Annotated[float, _about("Change of this ratio from one to the next.", gt=0, le=0.5)] = 0.08
    aspect_rate: Annotated[float, _about("Share of a change of this ratio that is followed at once.", ge=0, le=1)] = 0.2
    extent_score: Annotated[float, _about("Score below which size and ratio are held.")] = 0.5
    extent_penalty: Annotated[
        float, _about("Score that a change of size or ratio costs, times the logarithm of its factor.", ge=0)
    ] = 0.3
    extent_prior: Annotated[
        float,
        _about(
            "Score that being of another size or ratio than the first box costs, times the square of the logarithm "
            "of its factor.",
            ge=0,
        ),
    ] = 0.5
    extent_weight: Annotated[
        float, _about("Weight of the extent model beside the appearance model where size and ratio are chosen.", ge=0)
    ] = 1.0
    extent_sigma: Annotated[
        float, _about("Steps of size or ratio at which a window fits exp(-1/2) as well as the right one.", gt=0)
    ] = 1.0
    extent_frames: Annotated[int, _about("Frames from one lesson of size and ratio to the next.", ge=1)] = 2
    balance_slack: Annotated[
        float,
        _about(
            "Share of the window that the centre of the object's colours may come to lie beyond its first place, or "
            "the middle, before the box follows it (1: it never does).",
            ge=0,
            le=1,
        ),
    ] = 0.14
    distance_penalty: Annotated[
        float, _about("Score that a window's width of distance costs in the local search.", ge=0)
    ] = 0.1
    present_score: Annotated[float, _about("Score below which the object counts as absent.")] = 0.3
    present_share: Annotated[
        float,
        _about("The same as a share of the score that the object usually has: the higher one counts.", ge=0, le=1),
    ] = 0.45
    return_score: Annotated[float, _about("Score at which an absent object counts as present again.")] = 0.5
    return_share: Annotated[
        float,
        _about("The same as a share of the score that the object usually has: the higher one counts.", ge=0, le=1),
    ] = 0.65
    sighting_lead: Annotated[
        float,
        _about("Score by which the object of a saved model must lead the rest of the frame where it is first found."),
    ] = 0.25
    sighting_frames: Annotated[int, _about("Frames in a row that must agree on a first sighting.", ge=1)] = 3
    sure_score: Annotated[float, _about("Score below which the whole frame is searched now and then.")] = 0.55
    lost_score: Annotated[float, _about("Score below which the whole frame is searched in every frame.")] = 0.3
    jump_margin: Annotated[float, _about("Score by which a window elsewhere must be better than the one near.")] = 0.4
    trust_score: Annotated[
        float, _about("Score from which on a window found elsewhere teaches, and the whole frame is searched no more.")
    ] = 0.75
    whole_frames: Annotated[int, _about("Frames from one whole search to the next while unsure.", ge=1)] = 10
    teach_score: Annotated[float, _about("Score below which a frame teaches nothing.")] = 0.4
    copies: Annotated[
        int, _about("Affine copies of the object a frame (paper: 4 for n = 5 % of the video).", ge=0, le=64)
    ] = 3
    mirrored: Annotated[int, _about("How many of them are turned left to right.", ge=0)] = 1
    other_backgrounds: Annotated[
        float,
        _about(
            "Share of the first frame's affine copies that are put on another background: what is behind the object "
            "there is not learned with it.",
            ge=0,
            le=1,
        ),
    ] = 0.9
    object_weight: Annotated[
        float, _about("Ordinary rows that the object's row of a frame counts for in the loss tree.", gt=0)
    ] = 8.0
    near_misses: Annotated[int, _about("Windows a frame that lie beside the object.", ge=0)] = 12
    near_sigma: Annotated[
        float, _about("Distance, in cells, at which a near miss is worth exp(-1/2) of the object.", gt=0)
    ] = 0.9
    near_negatives: Annotated[int, _about("Background windows a frame around the object.", ge=1)] = 12
    far_negatives: Annotated[int, _about("Hard negatives from a whole frame.", ge=0)] = 10
    mine_frames: Annotated[int, _about("Frames from one search for hard negatives to the next.", ge=1)] = 8
    mine_score: Annotated[float, _about("Score below which none are searched for.")] = 0.6

    def __new__(cls, *unnamed: Any, **given: Any) -> Settings:
        if unnamed:
            raise SettingsError(
                f"settings are given by name, got {unnamed[0]!r}: for example Settings(coreset_size=128)"
            )
        for name in given:
            _check_name(name)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name in _kinds():
            object.__setattr__(self, name, _checked(name, getattr(self, name)))

    @classmethod
    def load(
        cls,
        *,
        preset: str | None = None,
        file: str | os.PathLike[str] | None = None,
        overrides: Mapping[str, Any] | Iterable[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> Settings:
        """Gather settings from all their places: those that `given` finds, the others by default.

        Raises
        ------
        SettingsError
            For a name that does not exist (names the nearest), or a value that
            does not fit.
        """
        return cls.of(cls.given(preset=preset, file=file, overrides=overrides, environment=environment))

    @staticmethod
    def given(
        *,
        preset: str | None = None,
        file: str | os.PathLike[str] | None = None,
        overrides: Mapping[str, Any] | Iterable[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> dict[str, Any]:
        """Names and values that are given somewhere, as `of` and `but` check them.

        Parameters
        ----------
        preset : str or None
            A name of `PRESETS`.
        file : path or None
            A TOML file with `name = value` lines.
        overrides : mapping of str, or iterable of str
            Names and values, or texts `name=value` as `--set` takes them.
        environment : mapping of str, or None
            Variables, `CATSTREAM_NAME=value`; None for the process's own.

        Raises
        ------
        SettingsError
            For a preset that does not exist, or a file that cannot be read.
        """
        values: dict[str, Any] = {}
        if preset is not None:
            if preset not in PRESETS:
                raise SettingsError(f"there is no preset {preset!r}: there are {', '.join(PRESETS)}")
            values.update(PRESETS[preset])
        if file is not None:
            values.update(_read(Path(file)))
        for variable, text in (os.environ if environment is None else environment).items():
            if variable.startswith("CATSTREAM_"):
                values[variable.removeprefix("CATSTREAM_").lower()] = text
        return values | _named(overrides)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Settings:
        """Check names and values; texts are read as their setting's type.

        Examples
        --------
        >>> Settings.of({"ridge": ".5", "lockstep": "true"}) == Settings(ridge=0.5, lockstep=True)
        True
        """
        return cls(
            **{name: _read_text(name, value) if isinstance(value, str) else value for name, value in values.items()}
        )

    def for_length(self, frames: int | None) -> Settings:
        """These settings for a video of so many frames: `coreset_share` becomes a `coreset_size`.

        Raises
        ------
        SettingsError
            Where there is a share and the length is not known.

        Examples
        --------
        >>> Settings(coreset_share=0.1).for_length(945).coreset_size
        94
        """
        if not self.coreset_share:
            return self
        if frames is None:
            raise SettingsError(
                f"coreset_share={self.coreset_share:g} is a share of the video's length, and this source has none: "
                "set coreset_size instead"
            )
        size = {"coreset_size": max(2, round(self.coreset_share * frames)), "coreset_share": 0.0}
        return Settings.of(self.values() | size)

    def but(self, others: Mapping[str, Any] | Iterable[str]) -> Settings:
        """These, but for some: names and values, or texts `name=value` as `--set` takes them.

        Examples
        --------
        >>> Settings(lockstep=True).but(["coreset_size=32"]).changed()
        ['lockstep=true', 'coreset_size=32']
        """
        return Settings.of(self.values() | _named(others))

    def values(self) -> dict[str, Any]:
        """All of them, by name."""
        return dataclasses.asdict(self)

    def changed(self) -> list[str]:
        """Those that differ from their default, as `load` takes them.

        Examples
        --------
        >>> Settings(lockstep=True, coreset_size=32).changed()
        ['lockstep=true', 'coreset_size=32']
        """
        fields, texts = dataclasses.fields(self), self.texts()
        return [f"{field.name}={texts[field.name]}" for field in fields if getattr(self, field.name) != field.default]

    def texts(self) -> dict[str, str]:
        """All of them as texts, by name; `of` reads them."""
        values = self.values().items()
        return {name: value if isinstance(value, str) else json.dumps(value) for name, value in values}


_PAPER = {
    "classifier": "one-class",
    "detection": "full",
    "bootstrap": "scm",
    "extent_weight": 0.0,
    "extent_prior": 0.0,
    "colours": False,
    "balance_slack": 1.0,
    "other_backgrounds": 0.0,
    "mirrored": 0,
    "present_share": 0.0,
    "return_share": 0.0,
    "trust_score": 0.0,
}

#: What the paper set, by name. Frames and copies together make 25 % of a video: 1.5 copies a frame at 10 %.
PRESETS: dict[str, dict[str, Any]] = {
    "one-class-paper": _PAPER | {"copies": 4},
    "cat10": _PAPER | {"coreset_share": 0.10, "copies": 1},
    "cat25": _PAPER | {"coreset_share": 0.25, "copies": 0},
}


def describe() -> list[tuple[str, str, Any, str]]:
    """Name, type, default and meaning of every setting: for `--help` and the docs."""
    kinds = _kinds()
    return [
        (field.name, _takes(field.name), field.default, kinds[field.name].__metadata__[0].description)
        for field in dataclasses.fields(Settings)
    ]


@cache
def _kinds() -> dict[str, Any]:
    """Type and bounds of each setting."""
    return get_type_hints(Settings, include_extras=True)


def _takes(name: str) -> str:
    """What a setting takes: its type, or the options, and its bounds."""
    kind, meta = _kinds()[name].__origin__, _kinds()[name].__metadata__[0]
    bounds = [
        f"{sign} {value:g}"
        for sign, value in ((">=", meta.ge), (">", meta.gt), ("<=", meta.le), ("<", meta.lt))
        if value is not None
    ]
    options = getattr(kind, "__args__", None)
    text = " | ".join(map(str, options)) if options else kind.__name__
    return " ".join([text, ", ".join(bounds)]).strip()


def _check_name(name: str) -> None:
    if name not in _kinds():
        near = [repr(other) for other in difflib.get_close_matches(name, _kinds(), n=3)]
        meant = f", did you mean {' or '.join(near)}?" if near else ":"
        raise SettingsError(f"there is no setting {name!r}{meant} `catstream settings` lists all {len(_kinds())}")


def _checked(name: str, value: Any) -> Any:
    """The value of a setting, of its type; a number of numpy is one of Python."""
    if isinstance(value, Number) and not isinstance(value, bool):
        value = getattr(value, "item", lambda: value)()
    try:
        checked = msgspec.convert(value, _kinds()[name])
    except msgspec.ValidationError:
        raise _misfit(name, value) from None
    if isinstance(checked, float) and not math.isfinite(checked):
        raise _misfit(name, value)
    return checked


def _read_text(name: str, text: str) -> Any:
    """The value that a text means, of the type of its setting."""
    _check_name(name)
    kind = _kinds()[name].__origin__
    try:
        if kind is bool:
            return msgspec.convert(text, bool, strict=False)
        return kind(text) if kind in (int, float) else text
    except (ValueError, msgspec.ValidationError):
        raise _misfit(name, text) from None


def _misfit(name: str, value: Any) -> SettingsError:
    return SettingsError(f"setting {name} cannot be {reprlib.repr(value)}: it takes {_takes(name)}")


def _named(given: Mapping[str, Any] | Iterable[str]) -> dict[str, Any]:
    return dict(given if isinstance(given, Mapping) else map(_pair, given))


def _pair(text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not sign:
        raise SettingsError(f"a setting is given as name=value, got {text!r}")
    return name.strip(), value.strip()


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise SettingsError(f"cannot read the settings file {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # not UTF-8, not TOML, or nested without end
        raise SettingsError(f"the settings file {path} is not TOML: {error}") from None
