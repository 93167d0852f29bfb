"""`catstream export`: other formats from the log of a run."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import click

from catstream.base.addresses import is_live
from catstream.base.files import locked_folder
from catstream.base.text import counted
from catstream.cli.options import PATH, with_overwrite
from catstream.cli.write import with_table
from catstream.errors import VideoError
from catstream.sinks import destinations
from catstream.sinks.destinations import EXPORTS, About, Head
from catstream.sinks.track_log import Log, logs_of
from catstream.video.source import VIDEOS, open_source
from catstream.video.writer import is_annotated


def _printable(_: click.Context, __: click.Parameter, text: str) -> str:
    if not text.isprintable():
        raise click.BadParameter(f"expected printable characters, got {text!r}")
    return text


def _classes(context: click.Context, parameter: click.Parameter, text: str) -> dict[str, int | None]:
    """The number of each class by name; None if only names are given."""
    classes: dict[str, int | None] = {}
    for entry in _printable(context, parameter, text).split(",") if text else ():
        name, equals, number = (word.strip() for word in entry.partition("="))
        if not name or name in classes or (equals and not re.fullmatch(r"[0-9]{1,9}", number)):
            raise click.BadParameter(f"expected a new NAME or NAME=NUMBER, got {entry!r}")
        classes[name] = int(number) if equals else None
    if None in classes.values() and set(classes.values()) != {None}:
        raise click.BadParameter("expected a number for all classes or for none")
    return classes


@click.command()
@click.argument("log", type=PATH)
@click.argument("dest", type=PATH)
@click.option("--format", "name", type=click.Choice(list(EXPORTS)), help="Format of DEST; required for a folder.")
@click.option(
    "--size",
    metavar="WIDTHxHEIGHT|SOURCE",
    help="Frame size, or the video or folder that was tracked, if LOG does not state it (CSV) or it was moved.",
)
@click.option(
    "--label",
    default="",
    callback=_printable,
    help="Class of all objects; by default, each object's name is its class.",
)
@click.option(
    "--classes",
    default="",
    metavar="NAME,...|NAME=NUMBER,...",
    callback=_classes,
    help="Class numbers for coco, cvat and yolo, in this order or as stated; by default in order of appearance.",
)
@click.option("--images", is_flag=True, help="Also write the images of the tracked frames, for yolo.")
@click.option("--append", is_flag=True, help="Add to an existing data set; its classes and labels stay unchanged.")
@click.option("--skip-damaged", is_flag=True, help="Continue after a damaged line of LOG.")
@with_overwrite
@with_table(EXPORTS)
def export(
    log: Path,
    dest: Path,
    name: str | None,
    size: str | None,
    label: str,
    classes: dict[str, int | None],
    images: bool,
    append: bool,
    skip_damaged: bool,
    overwrite: bool,
) -> None:
    """Convert the log of a run to another format.

    LOG is an .ndjson, .sqlite or .csv file of `catstream track` or `catstream
    sink`, or the folder of `catstream batch`, whose logs become one data set:
    yolo, coco, otb, got10k or vot. The extension of DEST or --format selects the format. A folder gets
    files for each object, such as NAME-OBJECT.txt; NAME is that of LOG. Frames
    have their numbers in the source. Only CSV stores processing times; CSV
    lacks the `doubtful` flag and the frame in which a reused name began.

    {table}

    \b
    EXAMPLES
      catstream export out/walk.ndjson walk.sqlite
      catstream export out/walk.csv results --format otb
      catstream export out/walk.ndjson walk.xml --label person
      catstream export out/walk.ndjson dataset --format yolo --classes dog,cat
      catstream export out/yard.ndjson dataset --format yolo --append
    """
    if append and overwrite:
        raise click.UsageError("--append and --overwrite are mutually exclusive")
    row = destinations.export_of(dest, name)
    if classes and not row.sized:
        raise click.UsageError("--classes requires a format with classes: coco, cvat or yolo")
    if images and row is not EXPORTS["yolo"]:
        raise click.UsageError("--images requires --format yolo")
    logs = logs_of(log)
    if log.is_dir() and not row.appends:
        formats = ", ".join(name for name, other in EXPORTS.items() if other.appends)
        raise VideoError(f"{log} is a folder, and this format holds one video: pass --format, one of {formats}")
    if (append or not row.suffix) and dest.absolute().parent.is_dir():  # others that add to a data set wait meanwhile
        click.get_current_context().with_resource(locked_folder(dest.absolute().parent, VideoError, math.inf))
    destinations.check_export(dest, row, overwrite=overwrite, append=append, log=log)
    for path in logs:
        content = Log(path, skip_damaged=skip_damaged)
        if next(content.frames(), None) is None:
            raise VideoError(f"{path} contains no tracks")
        about = About(path.stem, label=label, head=content.head() or Head(), classes=classes, append=append)
        about = _with_source(about, path, size, required=images, useful=row.images)
        last = max(frame.tracks[0].source_frame for frame in content)
        if about.frames is not None and last >= about.frames:  # of a long video, the number is an estimate
            has = f"but {size or about.head.source} has {counted(about.frames, 'frame')}"
            click.echo(f"warning: {path} has frame {last}, {has}: pass --size SOURCE if it is another one", err=True)
        if note := destinations.export(content, dest, row, about):
            click.echo(note, err=True)
        if content.damaged:
            click.echo(f"{counted(content.damaged, 'damaged line')} of {path} skipped", err=True)
        append = True


def _with_source(about: About, log: Path, size: str | None, *, required: bool, useful: bool) -> About:
    """Add what the source tells: the size of the frames, their number, and its images.

    required  whether the images are written
    useful    whether the format refers to them
    """
    source, frame_size = about.head.source, about.head.size
    if stated := re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", size or ""):
        frame_size = (int(stated[1]), int(stated[2]))
    elif size is not None:
        source = size
        if is_annotated(source):
            raise VideoError(
                f"{size} is an annotated video, which is higher than its frames: pass the source of the run"
            )
    if required and (not source or is_live(source)):
        raise VideoError(f"{log} names no source with images: pass --size SOURCE, or omit --images")
    if source == size or (useful and source and not is_live(source)):
        try:
            with open_source(source) as opened:
                frame_size = opened.size if source == size else frame_size
                about = replace(about, frames=opened.frames, images=opened.images, source=source if required else "")
        except VideoError as error:
            if source == size:
                raise
            if required or Path(source).suffix.lower() not in VIDEOS:  # the images of a folder have names
                raise VideoError(f"{error} (if it was moved, pass --size SOURCE)") from None
    if about.head.size is not None and frame_size != about.head.size:
        width, height = about.head.size
        raise VideoError(f"--size {size} contradicts {log}, whose frames are {width}x{height}: omit --size")
    return replace(about, size=frame_size)
