"""The options that every command takes to gather its settings."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from catstream.settings import PRESETS, Settings

__all__ = ["with_settings"]


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--settings`, `--preset` and `--set`; the command gets them as one argument `settings`."""

    @click.option("--settings", "file", type=click.Path(path_type=Path), help="TOML file of settings.")
    @click.option("--preset", type=click.Choice(list(PRESETS)), help="A named set of settings.")
    @click.option("--set", "pairs", multiple=True, metavar="NAME=VALUE", help="One setting; may be repeated.")
    @wraps(command)
    def wrapped(file: Path | None, preset: str | None, pairs: tuple[str, ...], **options: Any) -> None:
        command(settings=Settings.load(preset=preset, file=file, overrides=pairs), **options)

    return wrapped
