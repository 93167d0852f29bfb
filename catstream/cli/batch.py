"""`catstream batch`: tracks of many videos."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import click

from catstream.base.files import locked_folder
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.base.threads import cores
from catstream.cli.annotate import serve, show_progress
from catstream.cli.common import INTERRUPTS, line_of, messages, screen, stopped, table
from catstream.cli.options import FOLDER, PATH, with_overrides, with_overwrite, with_reading
from catstream.cli.view import HostPort, with_listen
from catstream.errors import BoxError, CatstreamError, VideoError

_NUMBERS = ("objects", "frames", "present", "doubtful", "checked")

if TYPE_CHECKING:
    from catstream.batch import Summary


@click.command()
@click.argument("files", nargs=-1, type=PATH, metavar="BOXES|VIDEO...")
@click.option("--ask", is_flag=True, help="Draw the boxes in the first frame of each VIDEO, on a page.")
@click.option("--output", type=FOLDER, required=True, help="Folder for the results.")
@click.option("--jobs", type=click.IntRange(min=1), help="Videos at a time; by default, the number of cores.")
@with_listen
@with_overwrite
@with_overrides
@with_reading
def batch(
    overrides: dict[str, object],
    files: tuple[Path, ...],
    ask: bool,
    output: Path,
    jobs: int | None,
    listen: HostPort,
    overwrite: bool,
) -> None:
    """Track objects in many videos.

    BOXES is a CSV file with the columns file, object, x, y, w, h, and optionally
    frame, which counts from 0. Paths are relative to its folder. Each object is
    tracked from its box to the end of the video. If it has boxes in several
    frames, it is tracked between them and checked, as by catstream annotate.

    With --ask, the command first serves a page on which boxes are drawn in the
    first frame of each VIDEO, with a token as for catstream view. Each box
    is saved at once in boxes.csv, and the button Done begins to track.

    A video that fails does not stop the others; the exit status is then 1. The
    same command continues after Ctrl-C, and tracks only videos that failed, are
    new, have other boxes, or whose log was removed, unless --overwrite is passed.

    \b
    OUTPUT
      NAME.ndjson, NAME.csv  the log of each video
      batch.csv              a row for each video: its tracks, how many of them
                             are present, doubtful and checked, and its error
      boxes.csv              with --ask: the boxes, for catstream batch

    \b
    EXAMPLES
      catstream batch boxes.csv --output out
      catstream batch --ask monday/*.mp4 --output out
      catstream export out dataset --format yolo
    """
    with INTERRUPTS.leaving():
        from catstream.batch import Batch, check_results, read_videos

    if not files or (len(files) > 1 and not ask):
        raise click.UsageError("expected one file BOXES, or videos after --ask")
    settings = Settings.from_values(overrides)
    boxes = _draw_boxes(files, output, settings, listen, overwrite=overwrite) if ask else files[0]
    videos = read_videos(boxes)
    if not videos:
        raise VideoError(f"{boxes} has no box: add a row for each object")
    if not overwrite:
        check_results(videos, output)
    click.get_current_context().with_resource(locked_folder(output, VideoError))
    batch = Batch(videos, output, overwrite=overwrite)
    jobs, total, console = jobs or cores(), len(batch.missing), messages()
    if not console.is_interactive:
        console.print(f"tracking {counted(total, 'video')}, {len(videos) - total} complete")
    began = time.monotonic()
    try:
        with line_of(console) as progress, closing(batch.track(settings, jobs)) as tracked:
            task = progress.add_task("tracking", total=total)
            for done, row in enumerate(tracked, 1):
                progress.update(task, advance=1, description=row.video)
                if not console.is_interactive:
                    left = timedelta(seconds=round((time.monotonic() - began) / done * (total - done)))
                    result = (
                        row.error or f"{counted(row.frames, 'frame')}, {row.present / max(row.tracks, 1):.0%} present"
                    )
                    console.print(f"{done} of {total} ({done / total:.0%}), {left} left: {row.video}: {result}")
    except KeyboardInterrupt:
        stopped("the results so far are saved; the same command continues")
    summaries = [batch.rows[video.file] for video in videos if video.file in batch.rows]
    _print(summaries)
    click.echo(f"results: {output}")
    if failed := sum(bool(row.error) for row in summaries):
        raise CatstreamError(
            f"{failed} of {counted(len(videos), 'video')} failed: the results of the others are complete"
        )


def _draw_boxes(
    videos: tuple[Path, ...], output: Path, settings: Settings, listen: HostPort, *, overwrite: bool
) -> Path:
    """Serve the page on which boxes are drawn in first frames until it is done; return the table of boxes."""
    from catstream.annotation.first_frames import FirstFrames
    from catstream.annotation.session import Session
    from catstream.batch import check_results, read_boxes, videos_of, write_boxes

    table = output / "boxes.csv"
    boxes = read_boxes(table) if table.exists() else {}
    for video in videos:
        path = video.parent.resolve() / video.name  # the folders may be symbolic links, the video keeps its name
        boxes.setdefault(os.path.relpath(path, output.resolve()), [])
    named = videos_of(table, boxes)  # errors that are better reported before any box is drawn
    if not overwrite:
        check_results(named, output)

    with ExitStack() as stack:
        stack.enter_context(locked_folder(output, VideoError))  # which makes it
        with line_of(messages()) as bar:
            bar.add_task("opening")
            frames = FirstFrames(output, boxes, settings, lambda *done: show_progress(bar, *done))
            stack.enter_context(frames)
        for error in frames.errors:
            click.echo(f"skipped: {error}", err=True)
        if not frames.videos:
            raise VideoError("none of the videos can be read")

        def check() -> None:
            if not frames.keyframes:
                raise BoxError("no box is drawn: draw one, or press Ctrl-C where the command runs")

        session = stack.enter_context(Session(frames, 1, lambda: write_boxes(table, frames.boxes), check))
        if serve(session, listen):
            stopped(f"the boxes so far are saved in {table}; the same command continues")
    return table


def _print(summaries: Iterable[Summary]) -> None:
    """Print a row for each video."""
    columns = table("video", "objects", "frames", "present", "doubtful", "checked", "error", right=_NUMBERS)
    for row in summaries:
        shares = (f"{count / row.tracks:.0%}" if row.tracks else "" for count in (row.present, row.doubtful))
        checked = f"{row.checked / row.tracks:.0%}" if row.checked else ""
        columns.add_row(row.video, str(row.objects), str(row.frames), *shares, checked, row.error)
    screen().print(columns)
