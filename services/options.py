"""Options that several commands share: settings, the object, and the frames of a source.

Each decorator adds options to a click command, and passes them on as one argument of the command's function.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TypeVar, cast

import click

from catstream.box import Box
from catstream.settings import PRESETS, Settings

__all__ = ["with_given", "with_model", "with_object", "with_part", "with_reading", "with_settings"]

_Command = TypeVar("_Command", bound=Callable[..., None])

with_model = click.option(
    "--model", type=click.Path(path_type=Path), metavar="FILE", help="Model of the object, written by `catstream save`."
)


def with_object(command: _Command) -> _Command:
    """Add `--box` and `--model`, of which at most one may be given, as the arguments `box` and `model`."""

    @click.option("--box", metavar="X,Y,W,H", help="The object in the first frame, in pixels.")
    @with_model
    @wraps(command)
    def wrapped(box: str | None, model: Path | None, **options: object) -> None:
        if box is not None and model is not None:
            raise click.UsageError(
                "--box gives the position of the object, and --model searches for it: give one of them"
            )
        command(box=Box.parse(box) if box is not None else None, model=model, **options)

    return cast(_Command, wrapped)


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
    """Add `--fps` and `--skip-damaged`, two settings for reading a file, to the argument `given`."""

    @click.option("--fps", type=float, metavar="N", help="Frames per second of a folder of images; 25 by default.")
    @click.option("--skip-damaged", is_flag=True, help="Continue after a damaged part of a video file.")
    @wraps(command)
    def wrapped(given: dict[str, object], fps: float | None, skip_damaged: bool, **options: object) -> None:
        rate = {} if fps is None else {"run.image_rate": fps}
        command(given=given | rate | ({"run.skip_damaged": True} if skip_damaged else {}), **options)

    return cast(_Command, wrapped)


def with_settings(command: _Command) -> _Command:
    """Add the options of `with_given`, as the argument `settings`: those that were given, the others by default."""

    @with_given
    @wraps(command)
    def wrapped(given: dict[str, object], **options: object) -> None:
        command(settings=Settings.from_values(given), **options)

    return cast(_Command, wrapped)
