"""`catstream sink`: write the tracks of a running pipeline to files."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path

import click
from rich.console import Console

from catstream.cli.attach import wait_for_pipeline, with_endpoint, with_wait
from catstream.cli.common import INTERRUPTS
from catstream.client.subscription import subscribe
from catstream.messages.kinds import Run
from catstream.messages.names import counted, listed
from catstream.services.options import PATH, with_part
from catstream.settings import Settings
from catstream.sinks.sink import check_writable, open_files, with_logs
from catstream.wire.channels import TRAINING
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber

_RUN_SECONDS = 1.0  # time-out for the message with the settings of the run


@click.command()
@click.argument("files", nargs=-1, required=True, type=PATH)
@with_endpoint
@with_wait
@click.option("--source", metavar="SOURCE", help="The source that the pipeline tracks, for an MP4.")
@with_part
def sink(files: tuple[Path, ...], endpoint: str, keys: str, wait: float, source: str | None, part: slice) -> None:
    """Write the tracks of a running pipeline to FILES, until it ends or Ctrl-C.

    The extension of a file selects its format; the file must not exist. Each
    track is written when it arrives, and stays written however the command
    ends. The pipeline does not wait; missed tracks are counted. For complete
    files use `catstream track --write`. If another run starts at the same
    endpoint, because the first one was killed, the command ends.

    \b
    FILES
      .ndjson    one JSON object for each track, one per line; also .jsonl
      -          the same, on standard output
      .csv       a row for each track: frame, seconds, state, box, score, model version, object
      .txt       MOT text: frame,id,x,y,w,h,score,-1,-1,-1, counted from 1
      .mp4       the frames of a file or folder (--source) with their tracks, with
                 the --start, --end and --stride of the pipeline; written at the end
      .json      one array of the JSON objects
      .sqlite    the table tracks
      .parquet   the same table; needs pip install "catstream[parquet]"

    The last three are made at the end from an .ndjson file of the same name, to
    which the tracks are written until then; it is kept.

    \b
    EXAMPLES
      catstream sink tracks.csv
      catstream sink tracks.ndjson tracks.sqlite tracks.parquet
      catstream sink - | jq .box
      catstream sink walk.mp4 --source recorded/walk.avi --endpoint run
    """
    for path in with_logs(files):
        check_writable(path)
    written, max_repeats, reason = 0, 0, ""
    newest: dict[str, int] = {}  # frame of the last track of each object
    with subscribe(endpoint, "tracks", keys=keys) as tracks:
        with suppress(KeyboardInterrupt), ExitStack() as stack:
            place = wait_for_pipeline(tracks.endpoint, tracks.keys, wait)
            sinks = stack.enter_context(open_files(files, source, part))
            status = stack.enter_context(Console(stderr=True).status("waiting for a track"))
            for track in tracks:
                max_repeats = max_repeats or _max_repeats(place)
                last = max(newest.values(), default=-1)
                if last - track.frame > max_repeats:
                    reason = ": the run had no end, and another one started"
                    break
                # A restarted detector repeats some frames; a track that was missed before is not written out of order.
                if track.frame < last or track.frame == newest.get(track.object):
                    continue
                with INTERRUPTS.deferred():  # a track is written to all files or to none
                    for each in sinks:
                        each.write([track])
                    written, newest[track.object] = written + 1, track.frame
                status.update(f"frame {track.frame}, {tracks.missed} missed")
        if tracks.end is not None:
            reason = f": {tracks.end.reason}"
        of = f" of {listed(newest)}" if any(newest) else ""
        click.echo(f"{counted(written, 'track')}{of}, {tracks.losses()}{reason}", err=True)


def _max_repeats(place: Endpoint) -> int:
    """Return how many tracks a restarted detector repeats at most: the setting `run.unstored_frames` of the run."""
    with Subscriber(TRAINING, place, only=Run) as runs:
        run = runs.receive(_RUN_SECONDS)
    return int(run.settings["run.unstored_frames"]) if isinstance(run, Run) else Settings().run.unstored_frames
