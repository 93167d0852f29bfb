"""`catstream export`: make other formats from the log of a run."""

from __future__ import annotations

from collections.abc import Callable
from inspect import cleandoc
from pathlib import Path
from typing import Any

import click

from catstream.errors import VideoError
from catstream.services.options import PATH, with_overwrite
from catstream.sinks.destinations import EXPORTS, SINKS, check_file, export_of
from catstream.sinks.destinations import export as make
from catstream.sinks.track_log import is_log, read_frames

Command = Callable[..., Any]


def with_table(*, sinks: bool) -> Callable[[Command], Command]:
    """Replace {table} in the help of a command by the lines of the sinks, or of the exports."""

    def changed(command: Command) -> Command:
        lines = (f"  {key:9} {row.meaning}" for key, row in (SINKS if sinks else EXPORTS).items())
        command.__doc__ = cleandoc(command.__doc__ or "").replace("{table}", "\n".join(["\b", *lines]))
        return command

    return changed


@click.command()
@click.argument("log", type=PATH)
@click.argument("dest", type=PATH)
@click.option("--format", "name", type=click.Choice(list(EXPORTS)), help="The format; needed for a folder.")
@with_overwrite
@with_table(sinks=False)
def export(log: Path, dest: Path, name: str | None, overwrite: bool) -> None:
    """Make another format from the log of a run.

    LOG is an .ndjson or .csv file of `catstream track` or `catstream sink`. The
    extension of DEST selects the format, or --format, which a folder needs. A
    folder gets the files of each object, NAME-OBJECT.txt for example; NAME is
    that of LOG. Processing times are in .csv only.

    {table}

    \b
    EXAMPLES
      catstream export out/walk.ndjson walk.sqlite
      catstream export out/walk.csv results --format otb
    """
    row = export_of(dest, name)
    if not is_log(log) or not log.is_file():
        raise VideoError(f"{log} is no log of a run: give an .ndjson or .csv file")
    if next(read_frames(log), None) is None:
        raise VideoError(f"{log} contains no tracks")
    if row.suffix:
        check_file(dest, may_exist=overwrite, source=str(log))
    make((frame for frame, _ in read_frames(log)), dest, row, log.stem)
