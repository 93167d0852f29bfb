"""`catstream batch`: tracks of many videos."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import click

from catstream.base.files import locked_folder
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.base.threads import cores
from catstream.cli.common import INTERRUPTS, line_of, messages, screen, stopped, table
from catstream.cli.options import FOLDER, PATH, with_overrides, with_overwrite, with_reading
from catstream.errors import CatstreamError, VideoError

_NUMBERS = ("objects", "frames", "present", "doubtful", "checked")

if TYPE_CHECKING:
    from catstream.batch import Summary


@click.command()
@click.argument("boxes", type=PATH)
@click.option("--output", type=FOLDER, required=True, help="Folder for the results.")
@click.option("--jobs", type=click.IntRange(min=1), help="Videos at a time; by default, the number of cores.")
@with_overwrite
@with_overrides
@with_reading
def batch(
    overrides: dict[str, object],
    boxes: Path,
    output: Path,
    jobs: int | None,
    overwrite: bool,
) -> None:
    """Track objects in many videos.

    BOXES is a CSV file with the columns file, object, x, y, w, h, and optionally
    frame, which counts from 0. Paths are relative to its folder. Each object is
    tracked from its box to the end of the video. If it has boxes in several
    frames, it is tracked between them and checked, as catstream annotate does.

    A video that fails does not stop the others; the exit status is then 1. The
    same command continues after Ctrl-C, and tracks only videos that failed, are
    new, have other boxes, or whose log was removed, unless --overwrite is passed.

    \b
    OUTPUT
      NAME.ndjson, NAME.csv  the log of each video
      batch.csv              a row for each video: its tracks, how many of them
                             are present, doubtful and checked, and its error

    \b
    EXAMPLES
      catstream batch boxes.csv --output out
      catstream batch walk-annotation/keyframes.csv --output out
      catstream export out dataset --format yolo
    """
    with INTERRUPTS.leaving():
        from catstream.batch import Batch, check_results, read_videos

    # Step 1: read the table, and lock the folder of the results.
    settings = Settings.from_values(overrides)
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
    # Step 2: track the missing videos.
    began = time.monotonic()
    try:
        with line_of(console) as progress, closing(batch.track(settings, jobs)) as tracked:
            task = progress.add_task("tracking", total=total)
            for done, row in enumerate(tracked, 1):
                progress.update(task, advance=1, description=row.video)
                if not console.is_interactive:
                    remaining = timedelta(seconds=round((time.monotonic() - began) / done * (total - done)))
                    present = f"{counted(row.frames, 'frame')}, {row.present / max(row.tracks, 1):.0%} present"
                    state = f"{done} of {total} ({done / total:.0%}), {remaining} left"
                    console.print(f"{state}: {row.video}: {row.error or present}")
    except KeyboardInterrupt:
        stopped("the results so far are saved; the same command continues")
    # Step 3: print the rows of all videos.
    summaries = [batch.rows[video.file] for video in videos if video.file in batch.rows]
    _print(summaries)
    click.echo(f"results: {output}")
    if failed := sum(bool(row.error) for row in summaries):
        raise CatstreamError(
            f"{failed} of {counted(len(videos), 'video')} failed: the results of the others are complete"
        )


def _print(summaries: Iterable[Summary]) -> None:
    """Print a row for each video."""
    columns = table("video", "objects", "frames", "present", "doubtful", "checked", "error", right=_NUMBERS)
    for row in summaries:
        shares = (f"{count / row.tracks:.0%}" if row.tracks else "" for count in (row.present, row.doubtful))
        checked = f"{row.checked / row.tracks:.0%}" if row.checked else ""
        columns.add_row(row.video, str(row.objects), str(row.frames), *shares, checked, row.error)
    screen().print(columns)
