"""`catstream annotate`: tracks between boxes at keyframes of a video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from catstream.base.files import write_atomically, writing
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.cli.common import INTERRUPTS, line_of, messages, stopped, text
from catstream.cli.options import FOLDER, PATH, with_overrides, with_overwrite, with_reading
from catstream.errors import VideoError
from catstream.jobs.job import Results

if TYPE_CHECKING:
    from catstream.annotation.annotation import Annotation
    from catstream.sinks.track_log import RunFiles


@click.command()
@click.argument("video")
@click.option(
    "--box",
    "texts",
    multiple=True,
    metavar="NAME@FRAME=X,Y,W,H",
    help="A box at a keyframe, in pixels; may be repeated.",
)
@click.option("--boxes", "csv_file", type=PATH, help="CSV file of boxes: frame,object,x,y,w,h.")
@click.option("--output", type=FOLDER, required=True, help="Folder for the results.")
@click.option("--jobs", type=click.IntRange(min=1), help="Number of processes; by default, that of the cores.")
@with_overwrite
@with_overrides
@with_reading
def annotate(
    overrides: dict[str, object],
    video: str,
    texts: tuple[str, ...],
    csv_file: Path | None,
    output: Path,
    jobs: int | None,
    overwrite: bool,
) -> None:
    """Track objects between boxes at keyframes, and say which frames are right.

    VIDEO is a file or a folder of images. Frames count from 0. A box is absent
    where the object is not in the frame: anna@412=absent. An object without a
    name is @FRAME=X,Y,W,H. One box of each object is enough to begin with.

    Each stretch between two keyframes is tracked from both of its ends. A frame
    is checked if the two agree so well that its box is right with a probability
    of 96 %. The command prints the frame to look at next: add its box, and run
    the command again with --boxes OUTPUT/keyframes.csv --overwrite.

    \b
    OUTPUT
      NAME.ndjson, NAME.csv  the log of the tracks, for catstream export, with
                             checked (keyframe, checked or unchecked) and
                             probability; unchecked boxes are doubtful
      keyframes.csv          all boxes: frame,object,x,y,w,h
      next.csv               frames to look at, those with most expected errors
                             first: frame,object,errors

    \b
    EXAMPLES
      catstream annotate walk.mp4 --box anna@0=120,80,64,48 --output out
      catstream annotate walk.mp4 --boxes out/keyframes.csv --box anna@412=300,90,60,50 --output out --overwrite
    """
    # Imported here so that --help and the other commands start faster.
    with INTERRUPTS.leaving():
        from catstream.annotation.annotation import Annotation
        from catstream.annotation.keyframes import by_object, parse_keyframe, read_keyframes, write_keyframes

    drawn = by_object([*([] if csv_file is None else read_keyframes(csv_file)), *map(parse_keyframe, texts)])
    if not drawn:
        raise click.UsageError("missing box: pass --box NAME@FRAME=X,Y,W,H or --boxes FILE.csv")
    # Checked before the work, which takes minutes.
    boxes, following = output / "keyframes.csv", output / "next.csv"
    for table in (boxes, following):
        if table.exists() and not overwrite:
            raise VideoError(f"{table} exists already: pass --overwrite, or another --output")
    bar = line_of(messages(), text("{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn())
    interrupted = False
    with bar:
        bar.add_task("decoding", total=None)
        with Annotation(
            video, drawn, Settings.from_values(overrides), jobs=jobs, progress=lambda *done: _show(bar, *done)
        ) as annotation:
            annotation.decode()
            files = _files(annotation, video, output, overwrite=overwrite)
            files.make_folder()
            write_keyframes(boxes, annotation.keyframes)
            try:
                annotation.track()
            except KeyboardInterrupt:
                interrupted = True
            with INTERRUPTS.deferred():
                _write(annotation, files, following)
    _report(annotation)
    click.echo(f"results: {output}")
    if interrupted:
        stopped(f"the results so far are in {output}")


def _show(bar: Progress, work: str, done: int, total: int | None) -> None:
    (task,) = bar.tasks
    if task.description != work:  # the remaining time is that of this part of the work
        bar.reset(task.id)
    bar.update(task.id, description=work, completed=done, total=total)


def _files(annotation: Annotation, video: str, output: Path, *, overwrite: bool) -> RunFiles:
    """The log of the tracks; raise VideoError if it could not be written."""
    from catstream.sinks.destinations import Head, Origin
    from catstream.sinks.track_log import RunFiles, places_of

    frames = annotation.frames
    changed = tuple(annotation.settings.changed())
    head = Head(source=video, size=frames.size, rate=frames.rate, frames=len(frames), settings=changed)
    origin = Origin(video, image_rate=frames.rate, head=head)
    files = RunFiles(origin, output, places_of(frames.name, Results(output=output)))
    files.check(overwrite=overwrite, earlier=[])
    return files


def _write(annotation: Annotation, files: RunFiles, following: Path) -> None:
    """Write the log, and the table of the frames to look at next."""
    from catstream.sinks.destinations import TrackedFrame

    with files.opened("") as write:
        for tracks in zip(*annotation.tracks.values(), strict=True):
            write(TrackedFrame(list(tracks)))
    rows = [f"{frame},{name},{errors:.1f}\n" for frame, name, errors in annotation.next_frames()]
    with writing(following, VideoError):
        write_atomically(following, "".join(["frame,object,errors\n", *rows]).encode())


def _report(annotation: Annotation) -> None:
    """Print how many frames of each object are checked, and the frame to look at next."""
    for name, checks in annotation.checked.items():
        count = len(checks) - checks.count("unchecked")
        boxes = counted(len(annotation.keyframes[name]), "keyframe")
        click.echo(
            f"{name and name + ': '}{count} of {len(checks)} frames checked ({count / len(checks):.0%}), {boxes}"
        )
    following = annotation.next_frame()
    if following is None:
        click.echo("all frames are checked")
    else:
        of = following.object and f" for {following.object}"
        errors = counted(max(round(following.errors), 1), "frame")
        click.echo(f"look next at frame {following.frame}{of}: about {errors} around it may be wrong")
