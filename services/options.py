"""Options that several commands share: settings, the objects, and the frames of a source.

Each decorator adds options to a click command, and passes them on as one argument of the command's function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import TypeVar, cast

import click

from catstream.errors import ObjectError
from catstream.messages.names import boxes_by_name, split_name
from catstream.settings import PRESETS, Settings

__all__ = ["named", "with_given", "with_model", "with_object", "with_part", "with_reading", "with_settings"]

_Command = TypeVar("_Command", bound=Callable[..., None])


def with_model(command: _Command) -> _Command:
    """Add `--model`, which may be repeated, as the argument `models`: a dict of files by the names of the objects."""

    @click.option(
        "--model",
        "files",
        multiple=True,
        metavar="[NAME=]FILE",
        help="Model of an object, written by `catstream save`.",
    )
    @wraps(command)
    def wrapped(files: tuple[str, ...], **options: object) -> None:
        command(models={name: Path(file) for name, file in named("--model", files).items()}, **options)

    return cast(_Command, wrapped)


def with_object(command: _Command) -> _Command:
    """Add `--box` and `--model`, which may be repeated, as the arguments `boxes` and `models`: dicts by name."""

    @click.option(
        "--box",
        "texts",
        multiple=True,
        metavar="[NAME=]X,Y,W,H",
        help="An object in the first frame, in pixels; may be repeated with names.",
    )
    @with_model
    @wraps(command)
    def wrapped(texts: tuple[str, ...], **options: object) -> None:
        command(boxes=boxes_by_name(named("--box", texts)), **options)

    return cast(_Command, wrapped)


def named(option: str, texts: Iterable[str]) -> dict[str, str]:
    """Return the values of an option by the names of the objects, from texts NAME=VALUE; the name "" if it has none.

    Raises
    ------
    ObjectError
        If a name is not valid, or two values have the same name.

    Examples
    --------
    >>> named("--box", ["anna=120,80,64,48", "ben=300,90,60,150"])
    {'anna': '120,80,64,48', 'ben': '300,90,60,150'}
    """
    values: dict[str, str] = {}
    for text in texts:
        name, value = split_name(text)
        if name in values and name:
            raise ObjectError(f"{option} {name}={values[name]} and {option} {text}: give each object its own name")
        if name in values:
            raise ObjectError(f"{option} {values[name]} and {option} {text}: give each object a name, NAME={value}")
        values[name] = value
    return values


def with_part(command: _Command) -> _Command:
    """Add `--start`, `--end` and `--stride`, as the argument `part`, a slice."""

    @click.option("--start", type=click.IntRange(0), metavar="N", help="First frame, for a file or folder.")
    @click.option("--end", type=click.IntRange(0), metavar="N", help="Frame before which to stop.")
    @click.option("--stride", type=click.IntRange(1), metavar="N", help="Track only every N-th frame.")
    @wraps(command)
    def wrapped(start: int | None, end: int | None, stride: int | None, **options: object) -> None:
        command(part=slice(start, end, stride), **options)

    return cast(_Command, wrapped)


def with_given(command: _Command) -> _Command:
    """Add `--settings`, `--preset` and `--set`, as the argument `given`: a dict of the settings that were given."""

    @click.option("--settings", "file", type=click.Path(path_type=Path), help="TOML file of settings.")
    @click.option("--preset", type=click.Choice(list(PRESETS)), help="A named set of settings.")
    @click.option("--set", "pairs", multiple=True, metavar="GROUP.NAME=VALUE", help="One setting; may be repeated.")
    @wraps(command)
    def wrapped(file: Path | None, preset: str | None, pairs: tuple[str, ...], **options: object) -> None:
        command(given=Settings.given(preset=preset, file=file, overrides=pairs), **options)

    return cast(_Command, wrapped)


def with_reading(command: _Command) -> _Command:
    """Add `--fps`, `--skip-damaged` and `--resize`, settings for reading a source, to the argument `given`."""

    @click.option("--fps", type=float, metavar="N", help="Frames per second of a folder of images; 25 by default.")
    @click.option("--skip-damaged", is_flag=True, help="Continue after a damaged part of a video file.")
    @click.option("--resize", is_flag=True, help="Scale images of another size to that of the first one.")
    @wraps(command)
    def wrapped(
        given: dict[str, object], fps: float | None, skip_damaged: bool, resize: bool, **options: object
    ) -> None:
        flags = {"run.skip_damaged": skip_damaged, "run.resize": resize}
        rate = {} if fps is None else {"run.image_rate": fps}
        command(given=given | rate | {name: True for name, flag in flags.items() if flag}, **options)

    return cast(_Command, wrapped)


def with_settings(command: _Command) -> _Command:
    """Add the options of `with_given`, as the argument `settings`: those that were given, the others by default."""

    @with_given
    @wraps(command)
    def wrapped(given: dict[str, object], **options: object) -> None:
        command(settings=Settings.from_values(given), **options)

    return cast(_Command, wrapped)
