"""`catstream sink`: write the tracks of a running pipeline to files."""

from __future__ import annotations

from contextlib import ExitStack, closing, suppress
from pathlib import Path

import click
from rich.console import Console

from catstream.cli.attach import wait_for_pipeline, with_endpoint, with_wait
from catstream.cli.interrupts import Interrupts
from catstream.messages import Run
from catstream.services.options import with_part
from catstream.settings import Settings
from catstream.sinks.sink import check, open_sink
from catstream.subscription import subscribe
from catstream.wire.channels import TRAINING
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber

__all__ = ["sink"]

_RUN_SECONDS = 1.0  # that a detector which follows frames may take to say what it runs with


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@with_endpoint
@with_wait
@click.option("--source", metavar="SOURCE", help="What the pipeline follows, for an MP4.")
@with_part
def sink(files: tuple[Path, ...], endpoint: str, keys: str, wait: float, source: str | None, part: slice) -> None:
    """Write the tracks of a running pipeline to FILES, until it ends or Ctrl-C.

    The end of a file's name says its format; none may be there yet. Each track
    is written as it comes, and what is written stays, however this ends. The
    pipeline does not wait: what was missed is counted. For files that miss
    nothing there is `catstream track --write`. If another run begins at the same
    place, the first one was killed, and this ends too.

    \b
    FILES
      .ndjson    an object a line, with the fields of a track; also .jsonl
      -          the same, on standard output
      .json      one array of such objects, which ends when the sink ends
      .csv       a row a frame: frame, seconds, state, box, score, model version
      .txt       MOT text: frame,1,x,y,w,h,score,-1,-1,-1, counted from 1
      .sqlite    the table tracks, in write-ahead mode: others may read meanwhile
      .parquet   made at the end, of the rows in FILE.parquet.sqlite
      .mp4       the frames with their tracks; of a file or folder (--source), with
                 the --start, --end and --stride of the pipeline; made at the end

    \b
    EXAMPLES
      catstream sink tracks.csv
      catstream sink tracks.ndjson tracks.sqlite tracks.parquet
      catstream sink - | jq .box
      catstream sink walk.mp4 --source recorded/walk.avi --endpoint run
    """
    for path in files:
        check(path)
    interrupts = Interrupts()
    interrupts.install()
    written, newest, reach, reason = 0, -1, 0, ""
    with subscribe(endpoint, "tracks", keys=keys) as tracks:
        with suppress(KeyboardInterrupt), ExitStack() as stack:
            place = wait_for_pipeline(tracks.endpoint, tracks.keys, wait)
            sinks = [stack.enter_context(closing(open_sink(path, source, part))) for path in files]
            status = stack.enter_context(Console(stderr=True).status("waiting for a track"))
            for track in tracks:
                reach = reach or _reach(place)
                if newest - track.frame > reach:
                    reason = ": it had no end, and another run began"
                    break
                if track.frame <= newest:  # a restarted detector repeats some
                    continue
                with interrupts.held():  # a track is in all files, and counted, or in none
                    for each in sinks:
                        each.write(track)
                    written, newest = written + 1, track.frame
                status.update(f"frame {newest}, {tracks.missed} missed")
        if tracks.end is not None:
            reason = f": {tracks.end.reason}"
        click.echo(f"{written} tracks, {tracks.losses()}{reason}", err=True)


def _reach(place: Endpoint) -> int:
    """How many tracks a restarted detector repeats at most: those that may be on their way, as the run was told."""
    with Subscriber(TRAINING, place, only=Run) as runs:
        run = runs.receive(_RUN_SECONDS)
    return int(run.settings["run.unstored_frames"]) if isinstance(run, Run) else Settings().run.unstored_frames
