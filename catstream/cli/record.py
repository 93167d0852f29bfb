"""`catstream record`: keep what a running pipeline says, in one file."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import click
from rich.console import Console

from catstream.cli.attach import wait_for_pipeline, with_endpoint, with_wait
from catstream.errors import RecordingError
from catstream.messages import End, Features, Run
from catstream.recording.file import Recording, RecordingWriter
from catstream.services.recorder import Recorder
from catstream.wire.announced import Announcement
from catstream.wire.endpoint import Endpoint, find
from catstream.wire.sockets import Subscriber

__all__ = ["record"]

_END_SECONDS = 1.0  # between the end of the tracks and that of the features


@click.command()
@click.option("--output", required=True, type=click.Path(path_type=Path), help="The file; it must not be there yet.")
@with_endpoint
@with_wait
def record(output: Path, endpoint: str, keys: str, wait: float) -> None:
    """Keep what a running pipeline says, in one file, until it ends or Ctrl-C.

    Features, models, tracks and health are written as they come, with the
    settings that the pipeline runs with; about 0.4 MB a frame. A crash
    at any moment leaves a file that can be read up to there.

    The pipeline does not wait: what came before this, or faster than it was
    taken, is missing, and said at the end. For a recording from the first frame,
    in which no features are missing: catstream track --record.

    \b
    EXAMPLES
      catstream record --output walk.mcap
      catstream record --output walk.mcap --endpoint run
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    place = find(endpoint, keys)
    with (
        Announcement(place, ("lessons", "tracks")) as waits,
        Subscriber("lessons", place, reader=waits.reader) as lessons,
    ):
        wait_for_pipeline(endpoint, keys, wait)
        with suppress(KeyboardInterrupt):
            _record(output, place, lessons, waits.reader)
    if output.exists():
        click.echo(f"{output}: {Recording(output)}", err=True)


def _record(output: Path, place: Endpoint, lessons: Subscriber, reader: str) -> None:
    with ExitStack() as stack:
        status = stack.enter_context(Console(stderr=True).status("waiting for the settings of the pipeline"))
        while not isinstance(run := lessons.receive(0.1), Run):
            if isinstance(run, End):
                raise RecordingError(f"nothing was recorded, as the pipeline has just ended: {run.reason}")
        writer = stack.enter_context(RecordingWriter(output, run))
        recorder = stack.enter_context(Recorder(writer, place, reader))
        seq, last, deadline = 0, None, float("inf")
        while (last is None or recorder.end is None) and time.monotonic() < deadline:
            message = lessons.receive(0.05)
            if isinstance(message, End):
                last = message
            # What a restarted detector finds anew, the compressor has taken already.
            if isinstance(message, Features) and message.seq > seq:
                seq = message.seq
                recorder.keep(message)
                status.update(f"frame {message.frame}, {writer.written} messages in {output}")
            recorder.listen()
            if recorder.failed:
                raise RecordingError(recorder.failed)
            if last is not None or recorder.end is not None:  # each travels by itself
                deadline = min(deadline, time.monotonic() + _END_SECONDS)
