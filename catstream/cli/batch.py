"""`catstream batch`: tracks of many videos."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from rich.console import RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.base.threads import cores
from catstream.cli.common import INTERRUPTS, messages, screen, stopped, table, text
from catstream.cli.options import FOLDER, PATH, with_overrides, with_overwrite, with_reading
from catstream.errors import CatstreamError

_NUMBERS = ("objects", "frames", "present", "doubtful", "checked")

if TYPE_CHECKING:
    from catstream.batch import Summary, Video


@click.command()
@click.argument("boxes", type=PATH)
@click.option("--output", type=FOLDER, required=True, help="Folder for the results.")
@click.option("--jobs", type=click.IntRange(min=1), help="Videos at a time; by default, the number of cores.")
@with_overwrite
@with_overrides
@with_reading
def batch(overrides: dict[str, object], boxes: Path, output: Path, jobs: int | None, overwrite: bool) -> None:
    """Track objects in many videos.

    BOXES is a CSV file with the columns file, object, x, y, w, h, and optionally
    frame, which counts from 0. Paths are relative to its folder. Each object is
    tracked from its box to the end of the video. If it has boxes in several
    frames, it is tracked between them and checked, as by catstream annotate.

    A video that fails does not stop the others; the exit status is then 1. The
    same command continues after Ctrl-C, and tracks only videos that failed, are
    new, or have other boxes, unless --overwrite is passed.

    \b
    OUTPUT
      NAME.ndjson, NAME.csv  the log of each video
      batch.csv              a row for each video: its tracks, how many of them
                             are present, doubtful and checked, and its error

    \b
    EXAMPLES
      catstream batch boxes.csv --output out
      catstream export out dataset --format yolo
    """
    with INTERRUPTS.leaving():
        from catstream.batch import check_results, read_summaries, read_videos, track_videos, write_summaries

    videos, path, settings = read_videos(boxes), output / "batch.csv", Settings.from_values(overrides)
    if not (overwrite or path.exists()):  # if it exists, all files there are of this batch
        check_results(videos, output)
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
