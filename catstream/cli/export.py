"""`catstream export`: converts the log of a run to other formats."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import click

from catstream.base.addresses import is_live
from catstream.base.files import locked_folder
from catstream.base.text import counted
from catstream.cli.options import PATH, with_overwrite
from catstream.cli.write import with_table
from catstream.errors import VideoError
from catstream.output import exports
from catstream.output.annotations import About, classes_of
from catstream.output.destinations import Header
from catstream.output.exports import EXPORTS
from catstream.output.track_log import JoinedLog, logs_of
from catstream.video.source import VIDEOS, open_source

#: Formats with classes.
_LABELLED = ", ".join(name for name, form in EXPORTS.items() if form.sized)


def _printable(_: click.Context, __: click.Parameter, text: str) -> str:
    if not text.isprintable():
        raise click.BadParameter(f"expected printable characters, got {text!r}")
    return text


def _classes(context: click.Context, parameter: click.Parameter, text: str) -> list[str]:
    """The names of the classes."""
    names = [name.strip() for name in _printable(context, parameter, text).split(",")] if text else []
    if not all(names) or len({*names}) < len(names):
        raise click.BadParameter(f"expected different names, NAME,NAME..., got {text!r}")
    return names


@click.command()
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="LOG...")
@click.argument("dest", type=PATH)
@click.option("--format", "name", type=click.Choice(list(EXPORTS)), help="Format of DEST; required for a folder.")
@click.option("--source", help="Tracked video or folder, if LOG does not state it (CSV) or it was moved.")
@click.option(
    "--label",
    default="",
    callback=_printable,
    help="Class of all objects; by default, each object's name is its class.",
)
@click.option(
    "--classes",
    default="",
    metavar="NAME,...",
    callback=_classes,
    help=f"Classes for {_LABELLED} in the order of their numbers; by default in order of appearance.",
)
@click.option("--images", is_flag=True, help="Also write the images of the tracked frames, for yolo.")
@click.option("--skip-damaged", is_flag=True, help="Continue after a damaged line of LOG.")
@with_overwrite
@with_table(EXPORTS)
def export(
    files: tuple[Path, ...],
    dest: Path,
    name: str | None,
    source: str | None,
    label: str,
    classes: list[str],
    images: bool,
    skip_damaged: bool,
    overwrite: bool,
) -> None:
    """Convert the log of a run to another format.

    LOG is an .ndjson, .sqlite or .csv file of `catstream track` or `catstream
    sink`, all rotated files of one run, or their folder. For yolo, it may be the
    folder of `catstream batch`, whose logs become one data set. The extension of
    DEST or --format selects the format. Frames have their numbers in the source.
    CSV lacks the `doubtful` flag and the frame in which a reused name began.

    {table}

    \b
    EXAMPLES
      catstream export out/walk.ndjson walk.sqlite
      catstream export out/walk.ndjson walk.xml --label person
      catstream export out/gate*.ndjson gate.csv
      catstream export out/walk.ndjson dataset --format yolo --images --classes dog,cat
    """
    # Step 1: check the options, and find the logs.
    form = exports.export_of(dest, name)
    if classes and not form.sized:
        raise click.UsageError(f"--classes requires a format with classes: {_LABELLED}")
    if images and form is not EXPORTS["yolo"]:
        raise click.UsageError("--images requires --format yolo")
    logs = logs_of(files, skip_damaged=skip_damaged)
    if form.suffix and len(logs) > 1:
        logs = [JoinedLog(logs)]
    # Step 2: for a folder, number the classes of all logs, and lock it.
    if not form.suffix:
        classes = classes or [*dict.fromkeys(name for content in logs for name in classes_of(content, label))]
        if dest.absolute().parent.is_dir():  # another export into this folder then waits
            click.get_current_context().with_resource(locked_folder(dest.absolute().parent, VideoError, math.inf))
    for file in files:
        exports.check_export(dest, form, overwrite=overwrite, log=file)
    # Step 3: convert each log, with facts from its source.
    for content in logs:
        path = content.path
        about = About(
            path.stem, content.header() or Header(), label=label, classes=classes, is_first=content is logs[0]
        )
        if len(logs) > 1:
            about = replace(about, prefix=f"{path.stem}_")
        about = _with_source(about, path, source, required=images, useful=form.images)
        if note := exports.export(content, dest, form, about):
            click.echo(note, err=True)
        if content.damaged:
            click.echo(f"{counted(content.damaged, 'damaged line')} of {path} skipped", err=True)
        if content.gap:
            click.echo(f"{path} lacks {counted(content.gap, 'frame')} (the disk was full)", err=True)


def _with_source(about: About, log: Path, override: str | None, *, required: bool, useful: bool) -> About:
    """Add the size of the frames, their number, and the images from the source.

    override  path of the source; None for the source that the log states
    required  whether the images are written
    useful    whether the format refers to them
    """
    source, size = override or about.header.source, about.header.size
    if required and (not source or is_live(source)):
        raise VideoError(f"{log} names no source with images: pass --source, or omit --images")
    if override or (useful and source and not is_live(source)):
        try:
            with open_source(source) as opened:
                if override and size not in (None, opened.size):
                    raise VideoError(
                        f"{log} has frames of {size}, not {opened.size} as {override}: pass another --source"
                    )
                size = size or opened.size
                about = replace(about, frames=opened.frames, images=opened.images, source=source if required else "")
        except VideoError as error:
            if override:
                raise
            if required or Path(source).suffix.lower() not in VIDEOS:  # the images of a folder have names
                raise VideoError(f"{error} (if it was moved, pass --source)") from None
    return replace(about, size=size)
