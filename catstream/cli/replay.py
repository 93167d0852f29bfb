"""`catstream replay`: play a recording to subscribers, or train from it again."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import click
from rich.console import Console

from catstream.cli.common import line_of, messages, screen, table
from catstream.errors import RecordingError
from catstream.messages.kinds import Features, Model, Run, Track
from catstream.services.options import PATH, NumberRange
from catstream.sinks.recording.file import Recording, RecordingWriter
from catstream.sinks.recording.learning import Prequential, Retraining, learn, prequential_of_recorded, require_features
from catstream.sinks.recording.player import Player
from catstream.wire.endpoint import Endpoint, meeting_place, private_folder


@click.command()
@click.argument("recording", type=PATH)
@click.option("--endpoint", default="", metavar="PLACE", help="Endpoint for subscribers; a new one by default.")
@click.option("--keys", default="", metavar="DIR", help="Folder of keys; subscribers then need keys.")
@click.option("--speed", type=NumberRange(0, min_open=True), default=1.0, help="Multiple of the recorded speed.")
@click.option("--fast", is_flag=True, help="Play without pauses.")
@click.option("--wait", is_flag=True, help="Start when the tracks have a subscriber.")
@click.option("--learn", "learns", is_flag=True, help="Train from the recorded features again.")
@click.option("--set", "pairs", multiple=True, metavar="NAME=VALUE", help="With --learn, a setting to change.")
@click.option("--output", type=PATH, help="With --learn, write the models to this recording.")
@click.option("--incomplete", is_flag=True, help="With --learn, accept missing features.")
def replay(
    recording: Path,
    endpoint: str,
    keys: str,
    speed: float,
    fast: bool,
    wait: bool,
    learns: bool,
    pairs: tuple[str, ...],
    output: Path | None,
    incomplete: bool,
) -> None:
    """Play a recording to subscribers, or train from it again.

    Without --learn, the recorded tracks, models, features and health are sent as
    the pipeline sent them: catstream watch, status and every subscriber work.

    With --learn, the recorded features are given to a new compressor and trainer,
    without the video. With the recorded settings, every recorded model must be
    reproduced bit for bit; otherwise the exit code is 1. --set shows the result of
    other settings for the same features.

    \b
    The table of --learn
      models     how many; a pipeline skips outdated samples, the replay skips none
      identical  recorded models that were reproduced bit for bit
      rows       inserted into the coreset trees
      levels     of the nodes of each object's own tree, oldest first
      MB         of all trees in memory
      seconds    of compression and training
      error      mean squared error of the scores of frames that the model had not seen
      apart      share of these frames in which the whole object scores above the background

    \b
    EXAMPLES
      catstream replay walk.mcap --wait
      catstream replay walk.mcap --endpoint run --fast
      catstream replay walk.mcap --learn
      catstream replay walk.mcap --learn --set coreset.size=128 --output larger.mcap
    """
    if not learns and (pairs or output or incomplete):
        raise click.UsageError("--set, --output and --incomplete need --learn")
    found, console = Recording(recording), messages()
    console.print(f"{recording}: {found}")
    if learns:
        _learn(found, pairs, output, incomplete, console)
    else:
        with ExitStack() as stack:
            stack.enter_context(suppress(KeyboardInterrupt))
            folder = stack.enter_context(private_folder())
            place = stack.enter_context(meeting_place(endpoint, folder, keys, str(recording.absolute())))
            _play(found, place, None if fast else speed, wait, console)


def _play(recording: Recording, place: Endpoint, speed: float | None, wait: bool, console: Console) -> None:
    with Player(recording, place) as player, console.status(f"at {place}, waiting for a subscriber") as status:
        if wait:
            player.wait()
        for message in player.play(speed):
            if isinstance(message, Track):
                status.update(f"at {place}, frame {message.frame} of {recording.frames} recorded")


def _learn(
    recording: Recording, pairs: tuple[str, ...], output: Path | None, incomplete: bool, console: Console
) -> None:
    require_features(recording, incomplete=incomplete)  # before the output file is created
    then, total = recording.settings, recording.counts[Features]
    trials = {"the same": then}
    if pairs:
        trials[" ".join(pairs)] = then.but(pairs).for_length(total)
    newest = next(reversed(trials))
    numbers = ("models", "identical", "rows", "levels", "MB", "seconds", "error", "apart")
    results = table("settings", *numbers, right=numbers)
    recorded = recording.counts[Model]
    results.add_row("as recorded", f"{recorded}", *["-"] * 5, *_prequential_cells(prequential_of_recorded(recording)))
    with ExitStack() as stack:
        progress = stack.enter_context(line_of(console))
        writer = None
        if output:
            writer = stack.enter_context(RecordingWriter(output, Run.from_settings(trials[newest].portable())))
            stack.push(lambda kind, *_: output.unlink() if kind else None)  # Ctrl-C leaves no part of the models
        for name, settings in trials.items():
            task = progress.add_task(name, total=total)
            result = learn(
                recording,
                settings,
                incomplete=incomplete,
                keep=writer.write if writer is not None and name == newest else None,
                step=partial(progress.advance, task),
            )
            same = f"{result.identical} of {recorded}"
            results.add_row(
                name, f"{result.models}", same, *_training_cells(result), *_prequential_cells(result.prequential)
            )
            if settings is then:
                differing = recorded - result.identical
    screen().print(results)
    if differing and not incomplete:
        raise RecordingError(
            f"{differing} of {recorded} recorded models were not reproduced: they were recorded by catstream "
            f"{recording.run.program} on another kind of processor (OpenBLAS chooses its instructions by it), with "
            "another version of catstream, numpy, scipy or OpenBLAS, or with OPENBLAS_NUM_THREADS set"
        )


def _training_cells(result: Retraining) -> list[str]:
    levels = "\n".join(" ".join(filter(None, [name, *map(str, own)])) for name, own in result.levels.items())
    rows, megabytes = result.counters["rows"], result.counters["bytes"] / 1e6
    return [f"{rows:.0f}", levels, f"{megabytes:.1f}", f"{result.seconds:.2f}"]


def _prequential_cells(prequential: Prequential) -> list[str]:
    return [f"{prequential.error:.4f}", f"{prequential.separated_share:.3f}"]
