"""Options that several commands take: settings, and which frames of a source."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from catstream.settings import PRESETS, Settings

__all__ = ["with_part", "with_settings"]


def with_part(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--start`, `--end` and `--stride`; the command gets them as one argument `part`, a slice."""

    @click.option("--start", type=click.IntRange(0), metavar="N", help="The first frame, of a file or folder.")
    @click.option("--end", type=click.IntRange(0), metavar="N", help="The frame to stop before.")
    @click.option("--stride", type=click.IntRange(1), metavar="N", help="Follow each N-th frame only.")
    @wraps(command)
    def wrapped(start: int | None, end: int | None, stride: int | None, **options: Any) -> None:
        command(part=slice(start, end, stride), **options)

    return wrapped


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--settings`, `--preset` and `--set`; the command gets them as one argument `settings`."""

    @click.option("--settings", "file", type=click.Path(path_type=Path), help="TOML file of settings.")
    @click.option("--preset", type=click.Choice(list(PRESETS)), help="A named set of settings.")
    @click.option("--set", "pairs", multiple=True, metavar="NAME=VALUE", help="One setting; may be repeated.")
    @wraps(command)
    def wrapped(file: Path | None, preset: str | None, pairs: tuple[str, ...], **options: Any) -> None:
        command(settings=Settings.load(preset=preset, file=file, overrides=pairs), **options)

    return wrapped
