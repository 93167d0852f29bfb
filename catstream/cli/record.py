"""`catstream record`: write the messages of a running pipeline to a file."""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from pathlib import Path

import click
from rich.console import Console

from catstream.cli.attach import wait_for_pipeline, with_endpoint, with_wait
from catstream.client.registry import locate
from catstream.errors import RecordingError, require_extra
from catstream.messages.kinds import End, Features, Run, Track
from catstream.services.options import PATH
from catstream.services.recorder import Recorder
from catstream.sinks.recording.file import Recording, RecordingWriter
from catstream.wire.channels import TRACKS, TRAINING
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber

_END_SECONDS = 1.0  # at most, between the ends of the tracks and of the features


@click.command()
@click.option("--output", required=True, type=PATH, help="The file to write; it must not exist.")
@with_endpoint
@with_wait
def record(output: Path, endpoint: str, keys: str, wait: float) -> None:
    """Write the messages of a running pipeline to a file, until it ends or Ctrl-C.

    Features, models, tracks and health are written when they arrive, with the
    settings of the pipeline; about 0.3 MB for each frame. The file is MCAP. After
    a crash it can be read up to the last whole message. After 100 000 messages,
    the recording continues in a second file, walk-2.mcap.

    The pipeline does not wait for the recording. Messages that were sent before it
    started, or that it received too slowly, are missing; their number is printed
    at the end. catstream track --record records all features from the first frame.
    A stream of a fleet is recorded until its pipeline ends, or moves to another node.

    \b
    EXAMPLES
      catstream record --output walk.mcap
      catstream record --output walk.mcap --endpoint run
    """
    require_extra("record")
    place = locate(endpoint, keys)
    with (
        Subscriber(TRAINING, place, early=True) as training,
        Subscriber(TRACKS, place, early=True) as tracks,
    ):
        wait_for_pipeline(endpoint, keys, wait)
        with suppress(KeyboardInterrupt):
            _record(output, place, training, tracks)
    if output.exists():
        click.echo(f"{output}: {Recording(output)}", err=True)


def _record(
    output: Path, place: Endpoint, training: Subscriber[Run | Features | End], tracks: Subscriber[Track | End]
) -> None:
    with ExitStack() as stack:
        status = stack.enter_context(Console(stderr=True).status("waiting for the settings of the pipeline"))
        while not isinstance(run := training.receive(0.1), Run):
            if isinstance(run, End):
                raise RecordingError(f"nothing was recorded, because the pipeline has ended: {run.reason}")
        writer = stack.enter_context(RecordingWriter(output, run))
        recorder = stack.enter_context(Recorder(writer, place, tracks))
        seq, last, deadline = 0, None, float("inf")
        while (last is None or recorder.end is None) and time.monotonic() < deadline:
            message = training.receive(0.05)
            if isinstance(message, End):
                last = message
            # A restarted detector repeats frames whose features the compressor has already processed.
            if isinstance(message, Features) and message.seq > seq:
                seq = message.seq
                recorder.write(message)
                status.update(f"frame {message.frame}, {writer.written} messages in {output}")
            recorder.receive()
            if recorder.failed:
                raise RecordingError(recorder.failed)
            if last is not None or recorder.end is not None:  # each channel has an end of its own
                deadline = min(deadline, time.monotonic() + _END_SECONDS)
