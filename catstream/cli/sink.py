"""`catstream sink`: write the tracks of a running pipeline to files."""

from __future__ import annotations

import signal
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import click
from rich.console import Console

from catstream.cli.attach import wait_for_pipeline
from catstream.extras import need
from catstream.messages import Run
from catstream.services.options import with_part
from catstream.settings import Settings
from catstream.sinks import parquet
from catstream.sinks.sink import open_sink
from catstream.subscription import subscribe
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Subscriber

__all__ = ["sink"]

_RUN_SECONDS = 1.0  # that a detector which follows frames may take to say what it runs with


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--endpoint", default="", metavar="PLACE", help="Where the pipeline runs; the only one where not given.")
@click.option("--keys", default="", metavar="DIR", help="Folder of the keys that it lets in, where it asks for some.")
@click.option("--wait", default=30.0, metavar="SECONDS", help="To wait for a pipeline that has not begun.")
@click.option("--source", metavar="SOURCE", help="What the pipeline follows, for an MP4.")
@click.option("--parquet", "columns", type=click.Path(path_type=Path), help="Export the database to this at the end.")
@with_part
def sink(
    files: tuple[Path, ...],
    endpoint: str,
    keys: str,
    wait: float,
    source: str | None,
    columns: Path | None,
    part: slice,
) -> None:
    """Write the tracks of a running pipeline to FILES, until it ends or Ctrl-C.

    What a file is for is said by how its name ends; none may be there yet. Each
    track is written as it comes, and what is written stays, however this ends; an
    MP4 needs an orderly end. The pipeline does not wait: what was missed is
    counted. Where another begins at the same place, the first was killed: that is
    its end too.

    \b
    FILES
      .ndjson    an object a line, as on the wire
      .csv       a row a frame: frame, seconds, state, box, score, model version
      .txt       MOT text: frame,1,x,y,w,h,score,-1,-1,-1, counted from 1
      .sqlite    the table tracks, in write-ahead mode: others may read meanwhile
      .mp4       the frames with their tracks; of a file or folder (--source), with
                 the --start, --end and --stride of the pipeline

    \b
    EXAMPLES
      catstream sink tracks.csv
      catstream sink tracks.ndjson tracks.sqlite --parquet tracks.parquet
      catstream sink walk.mp4 --source recorded/walk.avi --endpoint run
    """
    databases = [path for path in files if path.suffix == ".sqlite"]
    if columns is not None:
        if not databases:
            raise click.UsageError("--parquet is made from a database: name a .sqlite file too")
        need("parquet")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
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
                for each in sinks:
                    each.write(track)
                written, newest = written + 1, track.frame
                status.update(f"frame {newest}, {tracks.missed} missed")
        if tracks.end is not None:
            reason = f": {tracks.end.reason}"
        click.echo(f"{written} tracks, {tracks.losses()}{reason}", err=True)
    if columns is not None:
        parquet.export(databases[0], columns)


def _reach(place: Endpoint) -> int:
    """How many tracks a restarted detector repeats at most: those that may be on their way, as the run was told."""
    with Subscriber("lessons", place, only=Run) as runs:
        run = runs.receive(_RUN_SECONDS)
    return int(run.settings["window"]) if run is not None else Settings().window
