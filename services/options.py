"""Options that several commands take: settings, the object, and which frames of a source."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from catstream.box import Box
from catstream.settings import PRESETS, Settings

__all__ = ["with_given", "with_model", "with_object", "with_part", "with_reading", "with_settings"]

with_model = click.option(
    "--model", type=click.Path(path_type=Path), metavar="FILE", help="What `catstream save` wrote of the object."
)


def with_object(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--box` and `--model`, one of them at most; the command gets a Box or None, and a path or None."""

    @click.option("--box", metavar="X,Y,W,H", help="The object in the first frame, in pixels.")
    @with_model
    @wraps(command)
    def wrapped(box: str | None, model: Path | None, **options: Any) -> None:
        if box is not None and model is not None:
            raise click.UsageError("--box says where the object is, with --model it is searched for: give one of them")
        command(box=Box.parse(box) if box is not None else None, model=model, **options)

    return wrapped


def with_part(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--start`, `--end` and `--stride`; the command gets them as one argument `part`, a slice."""

    @click.option("--start", type=click.IntRange(0), metavar="N", help="The first frame, of a file or folder.")
    @click.option("--end", type=click.IntRange(0), metavar="N", help="The frame to stop before.")
    @click.option("--stride", type=click.IntRange(1), metavar="N", help="Follow each N-th frame only.")
    @wraps(command)
    def wrapped(start: int | None, end: int | None, stride: int | None, **options: Any) -> None:
        command(part=slice(start, end, stride), **options)

    return wrapped


def with_given(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--settings`, `--preset` and `--set`; the command gets what is given as one argument `given`, a dict."""

    @click.option("--settings", "file", type=click.Path(path_type=Path), help="TOML file of settings.")
    @click.option("--preset", type=click.Choice(list(PRESETS)), help="A named set of settings.")
    @click.option("--set", "pairs", multiple=True, metavar="GROUP.NAME=VALUE", help="One setting; may be repeated.")
    @wraps(command)
    def wrapped(file: Path | None, preset: str | None, pairs: tuple[str, ...], **options: Any) -> None:
        command(given=Settings.given(preset=preset, file=file, overrides=pairs), **options)

    return wrapped


def with_reading(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--fps` and `--skip-damaged`, the settings of how a file is read, to what the command gets as `given`."""

    @click.option("--fps", type=float, metavar="N", help="Frames per second of a folder of images; 25 by default.")
    @click.option("--skip-damaged", is_flag=True, help="Go on after a damaged place in a video file.")
    @wraps(command)
    def wrapped(given: dict[str, Any], fps: float | None, skip_damaged: bool, **options: Any) -> None:
        rate = {} if fps is None else {"run.image_rate": fps}
        command(given=given | rate | ({"run.skip_damaged": True} if skip_damaged else {}), **options)

    return wrapped


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Add the same; the command gets them, and the others by default, as one argument `settings`."""

    @with_given
    @wraps(command)
    def wrapped(given: dict[str, Any], **options: Any) -> None:
        command(settings=Settings.of(given), **options)

    return wrapped
