"""`catstream batch`: tracks of many videos."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from catstream.base.files import locked_folder
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.base.threads import cores
from catstream.cli.annotate import wait_for
from catstream.cli.common import INTERRUPTS, line_of, messages, screen, stopped, table
from catstream.cli.options import FOLDER, PATH, with_overrides, with_overwrite, with_reading
from catstream.cli.view import HostPort, with_listen, with_token
from catstream.errors import BoxError, CatstreamError, VideoError

_NUMBERS = ("objects", "frames", "present", "doubtful", "checked")

if TYPE_CHECKING:
    from catstream.annotation.keyframes import Keyframe
    from catstream.batch import Summary, Video


@click.command()
@click.argument("files", nargs=-1, type=PATH, metavar="BOXES|VIDEO...")
@click.option("--ask", is_flag=True, help="Draw the boxes in the first frame of each VIDEO, on a page.")
@click.option("--output", type=FOLDER, required=True, help="Folder for the results.")
@click.option("--jobs", type=click.IntRange(min=1), help="Videos at a time; by default, the number of cores.")
@with_listen
@with_token()
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
    token: str | None,
    overwrite: bool,
) -> None:
    """Track objects in many videos.

    BOXES is a CSV file with the columns file, object, x, y, w, h, and optionally
    frame, which counts from 0. Paths are relative to its folder. Each object is
    tracked from its box to the end of the video. If it has boxes in several
    frames, it is tracked between them and checked, as by catstream annotate.

    With --ask, the command serves a page that shows the first frame of each VIDEO,
    see --listen and --token of catstream view. Boxes are drawn in all of them, and
    each is saved at once in boxes.csv; then Done begins to track. The same command
    continues with these boxes, also for more videos.

    A video that fails does not stop the others; the exit status is then 1. The
    same command continues after Ctrl-C, and tracks only videos that failed, are
    new, or have other boxes, unless --overwrite is passed.

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
        from catstream.batch import Batch, check_results, read_boxes, videos_of

    drawn, settings = output / "boxes.csv", Settings.from_values(overrides)
    if ask:
        boxes = read_boxes(drawn) if drawn.exists() else {}
        boxes |= {file: [] for file in (_relative(file, output) for file in files) if file not in boxes}
        videos = videos_of(drawn, boxes)
    else:
        videos = videos_of(*files, read_boxes(*files)) if len(files) == 1 else []
    if not videos:
        raise click.UsageError("expected one file BOXES with a row for each box, or videos after --ask")
    if not overwrite:
        check_results(videos, output)
    if ask:
        videos = _ask_for_boxes(drawn, boxes, settings, listen, token)

    batch = Batch(videos, output, overwrite=overwrite)
    try:
        with line_of(messages()) as progress, closing(batch.track(settings, jobs or cores())) as tracked:
            task = progress.add_task("tracking", total=len(batch.missing))
            for video in tracked:
                progress.update(task, advance=1, description=video.name)
    except KeyboardInterrupt:
        stopped("the results so far are saved; the same command continues")
    summaries = [row for row in batch.rows if row is not None]
    _print(summaries)
    click.echo(f"results: {output}")
    if failed := sum(bool(row.error) for row in summaries):
        raise CatstreamError(
            f"{failed} of {counted(len(videos), 'video')} failed: the results of the others are complete"
        )


def _relative(file: Path, folder: Path) -> str:
    """The path of a file relative to a folder, either of which may be in a symbolic link."""
    path = file.parent.resolve() / file.name
    try:
        return os.path.relpath(path, folder.resolve())
    except ValueError:  # on another drive of Windows
        return str(path)


def _ask_for_boxes(
    path: Path, boxes: dict[str, list[Keyframe]], settings: Settings, listen: HostPort, token: str | None
) -> list[Video]:
    """Serve the page on which boxes are drawn until it is done; return the videos with boxes, and unreadable ones."""
    from catstream.annotation.first_frames import FirstFrames
    from catstream.annotation.session import Session
    from catstream.batch import videos_of, write_boxes
    from catstream.web.annotator import AnnotationSite
    from catstream.web.server import Server

    bar = line_of(messages())
    with ExitStack() as stack:
        stack.enter_context(locked_folder(path.parent, VideoError))  # which makes it
        with bar:
            task = bar.add_task("opening")
            frames = stack.enter_context(
                FirstFrames(
                    path.parent, boxes, settings, lambda _, done, total: bar.update(task, completed=done, total=total)
                )
            )
        for error in frames.errors.values():
            click.echo(f"skipped: {error}", err=True)
        if frames.videos:

            def check() -> None:
                if not frames.keyframes:
                    raise BoxError("no box is drawn: draw one, or press Ctrl-C where the command runs")

            session = stack.enter_context(Session(frames, 1, lambda: write_boxes(path, frames.boxes), check))
            site = AnnotationSite(session)
            if wait_for(session, Server(site, host=listen.host, port=listen.port, token=token)):
                stopped(f"the boxes so far are saved in {path}; the same command continues")
        videos = videos_of(path, frames.boxes)
        if empty := [video.file for video in videos if not video.keyframes and video.file not in frames.errors]:
            click.echo(f"not tracked, because no box is drawn: {', '.join(empty)}", err=True)
        return [video for video in videos if video.file not in empty]


def _print(summaries: Iterable[Summary]) -> None:
    """Print a row for each video."""
    columns = table("video", "objects", "frames", "present", "doubtful", "checked", "error", right=_NUMBERS)
    for row in summaries:
        shares = (f"{count / row.tracks:.0%}" if row.tracks else "" for count in (row.present, row.doubtful))
        checked = f"{row.checked / row.tracks:.0%}" if row.checked else ""
        columns.add_row(row.video, str(row.objects), str(row.frames), *shares, checked, row.error)
    screen().print(columns)
