"""`catstream batch`: tracks of many videos."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from rich.console import RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from catstream.base.files import locked_folder
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.base.threads import cores
from catstream.cli.annotate import wait_for
from catstream.cli.common import INTERRUPTS, line_of, messages, screen, stopped, table, text
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
        from catstream.batch import (
            check_results,
            read_boxes,
            read_summaries,
            read_videos,
            track_videos,
            videos_of,
            write_summaries,
        )

    drawn, path, settings = output / "boxes.csv", output / "batch.csv", Settings.from_values(overrides)
    if ask:
        boxes = read_boxes(drawn) if drawn.exists() else {}
        boxes |= {file: [] for file in (_relative(file, output) for file in files) if file not in boxes}
        videos = videos_of(drawn, boxes)
    else:
        videos = read_videos(*files) if len(files) == 1 else []
    if not videos:
        raise click.UsageError("expected one file BOXES, or videos after --ask")
    if not (overwrite or path.exists()):  # if it exists, all files there are of this batch
        check_results(videos, output)
    if ask:
        videos = _ask_for_boxes(drawn, boxes, settings, listen, token)
    complete = {} if overwrite else {row.video: row for row in read_summaries(path) if not row.error}
    rows = {video.name: complete.get(video.file) for video in videos}
    missing = [video for video in videos if (row := rows[video.name]) is None or row.boxes != video.boxes]
    rows |= dict.fromkeys((video.name for video in missing), None)
    write_summaries(path, filter(None, rows.values()))
    jobs = min(jobs or cores(), max(len(missing), 1))
    with tempfile.TemporaryDirectory(prefix="catstream-batch-") as folder:
        counts = Path(folder) / "counts"
        tracked = track_videos(missing, output, settings, jobs, counts)
        try:
            with closing(tracked), _Lines(missing, counts):
                for video, summary in tracked:
                    rows[video.name] = summary
                    write_summaries(path, filter(None, rows.values()))
        except KeyboardInterrupt:
            stopped("the results so far are saved; the same command continues")
    summaries = [row for row in rows.values() if row is not None]
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


class _Lines(Progress):
    """A line for each video that is tracked at the moment, and one for all; nothing if there is no terminal."""

    def __init__(self, videos: Iterable[Video], counts: Path) -> None:
        self._counts = counts  # first: the constructor renders the lines
        console = messages()
        columns = (text("{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn())
        super().__init__(*columns, console=console, transient=True, disable=not console.is_terminal)
        for video in videos:
            self.add_task(video.name, total=None, visible=False)

    def get_renderables(self) -> Iterable[RenderableType]:
        if self._counts.exists():
            for task, (done, total) in zip(self.tasks, np.fromfile(self._counts, np.int64).reshape(-1, 2), strict=True):
                self.update(task.id, completed=done, total=total or None, visible=0 < done != total)
        return super().get_renderables()


def _print(summaries: Iterable[Summary]) -> None:
    """Print a row for each video."""
    columns = table("video", "objects", "frames", "present", "doubtful", "checked", "error", right=_NUMBERS)
    for row in summaries:
        shares = (f"{count / row.tracks:.0%}" if row.tracks else "" for count in (row.present, row.doubtful))
        checked = f"{row.checked / row.tracks:.0%}" if row.checked else ""
        columns.add_row(row.video, str(row.objects), str(row.frames), *shares, checked, row.error)
    screen().print(columns)
