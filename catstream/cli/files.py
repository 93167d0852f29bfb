"""The files that commands write: checks before the work, and figures as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import click

from catstream.errors import ServiceError
from catstream.messages.storage import why_not_writable, writing
from catstream.services.options import PATH


def check_file(file: Path, *, overwrite: bool, made: Path | None = None) -> None:
    """Check before the work that a file can be written.

    Parameters
    ----------
    overwrite : whether it may exist
    made : a folder that is made before the file, if it does not exist

    Raises
    ------
    ServiceError
        If it cannot, or if it exists already and may not be replaced.
    """
    if file.exists() and not overwrite:
        raise ServiceError(f"{file} exists already: replace it with --overwrite, or give another name")
    if reason := why_not_writable(file, made):
        raise ServiceError(reason)


def _checked(_: click.Context, __: click.Parameter, file: Path | None) -> Path | None:
    if file is not None:
        if file.is_file() and file.suffix != ".json":
            raise ServiceError(f"{file} exists already, and only a file whose name ends with .json is replaced")
        check_file(file, overwrite=True)
    return file


with_json_file = click.option("--json", "json_file", type=PATH, callback=_checked, help="File for all figures.")


def write_json(file: Path | None, figures: dict[str, object]) -> None:
    """Write figures to a file, if one is given.

    Raises
    ------
    ServiceError
        If it cannot be written.
    """
    if file is not None:
        with writing(file):
            file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
