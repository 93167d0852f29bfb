"""`catstream set-box`, `search`, `forget`, `pause`, `resume`, `save` and `stop`: commands to a running pipeline."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path

import click

from catstream.box import Box
from catstream.cli.attach import with_endpoint
from catstream.cli.common import check_file
from catstream.client.control import Control, control
from catstream.errors import ServiceError
from catstream.messages.names import UNNAMED, check_name, split_name
from catstream.run.job import Job
from catstream.run.state import learned
from catstream.services.options import FOLDER, PATH, NumberRange, combined, with_overwrite


@dataclass(frozen=True, slots=True)
class _Target:
    """The pipeline that a command is for, as given by the options."""

    endpoint: str
    source: str
    keys: str
    timeout: float
    yes: bool

    def __post_init__(self) -> None:
        if self.endpoint and self.source:
            raise click.UsageError("--source selects the pipeline, as --endpoint and --stream do: give one of them")

    @property
    def is_named(self) -> bool:
        return bool(self.endpoint or self.source)

    def control(self) -> Control:
        """Connect to the pipeline and print its name. At a terminal, ask for confirmation if it was not named."""
        pipeline = control(self.endpoint, timeout=self.timeout, keys=self.keys, source=self.source)
        line = f"pipeline: {pipeline.source or 'a pipeline'} at {pipeline.endpoint}"
        if self.endpoint and not pipeline.source:
            pass  # nothing more is known than the endpoint
        elif self.is_named or self.yes or not sys.stdin.isatty():
            click.echo(line, err=True)
        elif not click.confirm(f"{line}. Is this the right one?", default=True, err=True):
            pipeline.close()
            raise ServiceError("no command was sent: name the pipeline with --endpoint or --source")
        return pipeline


#: Adds the options that select a pipeline, as one argument `target`.
_with_pipeline = combined(
    "target",
    _Target,
    with_endpoint,
    click.option(
        "--source", default="", metavar="SOURCE", help="The source that the pipeline tracks, instead of --endpoint."
    ),
    click.option(
        "--timeout", default=5.0, show_default=True, type=NumberRange(0), help="Seconds to wait for an answer."
    ),
    click.option("--yes", is_flag=True, help="Do not ask for confirmation."),
)


def _with_control(command: Callable[..., str]) -> Callable[..., None]:
    """Add the same options; the command gets a `Control`, and its return value is printed."""

    @_with_pipeline
    @wraps(command)
    def wrapped(target: _Target, **options: object) -> None:
        with target.control() as pipeline:
            click.echo(command(pipeline, **options))

    return wrapped


@click.command("set-box", context_settings={"ignore_unknown_options": True})  # -3,40,60,60 is a box
@click.argument("box", metavar="[NAME=]X,Y,W,H")
@click.option("--keep", is_flag=True, help="Same object: keep what was learned.")
@_with_control
def set_box(pipeline: Control, box: str, keep: bool) -> str:
    """Set the box of an object in a running pipeline.

    X,Y,W,H is the box in pixels in the next frame that is tracked; during a
    pause of a file, in the frame that is held. A new NAME begins an object
    beside the others; an object that has this name already is replaced, and
    everything learned of it is dropped. Without NAME, the only object is meant.

    \b
    EXAMPLES
      catstream set-box 120,80,64,48
      catstream set-box anna=120,80,64,48
      catstream set-box anna=118,83,64,48 --keep
    """
    name, value = split_name(box)
    return pipeline.set_box(Box.parse(value), name, keep=keep).reason


@click.command()
@click.argument("file", metavar="[NAME=]FILE")
@_with_control
def search(pipeline: Control, file: str) -> str:
    """Search for the object of a saved model in a running pipeline.

    The object is absent until it is found in the whole frame, and learning
    continues from FILE, which `catstream save` wrote. An object that has the
    NAME already is replaced. Without NAME, the only object is meant.

    \b
    EXAMPLES
      catstream search walker.safetensors
      catstream search anna=anna.safetensors --endpoint run
    """
    name, path = split_name(file)
    return pipeline.search(path, name).reason


@click.command()
@click.argument("name", default=UNNAMED)
@_with_control
def forget(pipeline: Control, name: str) -> str:
    """Stop tracking an object in a running pipeline.

    Everything learned of it is dropped. Without NAME, the only object is meant.
    If no object is left, the run waits for `catstream set-box`.

    \b
    EXAMPLES
      catstream forget anna
    """
    return pipeline.forget(name).reason


@click.command()
@_with_control
def pause(pipeline: Control) -> str:
    """Pause a running pipeline.

    A file waits; the frames of a camera or a stream are counted as skipped.
    `catstream resume` continues.

    \b
    EXAMPLES
      catstream pause
    """
    return pipeline.pause().reason


@click.command()
@_with_control
def resume(pipeline: Control) -> str:
    """Resume a paused pipeline.

    \b
    EXAMPLES
      catstream resume
    """
    return pipeline.resume().reason


@click.command()
@click.argument("file", type=PATH)
@click.option("--object", "name", default=UNNAMED, metavar="NAME", help="Name of the object; default: the only one.")
@click.option("--state", type=FOLDER, metavar="FOLDER", help="State folder of a run, which may have ended.")
@with_overwrite
@_with_pipeline
def save(target: _Target, file: Path, state: Path | None, name: str, overwrite: bool) -> None:
    """Save everything that a pipeline has learned of an object to FILE.

    `catstream track SOURCE --model FILE` finds the object and continues to
    learn. With --state, the newest checkpoint in that folder is saved, and no
    pipeline has to run.

    \b
    EXAMPLES
      catstream save walker.safetensors
      catstream save anna.safetensors --object anna
      catstream save walker.safetensors --state checkpoints
    """
    check_file(file, overwrite=overwrite)
    if state is None:
        with target.control() as pipeline:
            version = pipeline.save(file, name).version
    elif target.is_named:
        raise click.UsageError(
            "--state names the folder of a run, --endpoint and --source a running pipeline: give one"
        )
    else:
        content = learned(state, Job.load(state).settings, check_name(name))
        content.save(file)
        version = content.model.version
    click.echo(f"model {version} is in {file}")


@click.command()
@_with_control
def stop(pipeline: Control) -> str:
    """Stop a running pipeline as if its source had ended.

    Everything learned is stored first, and the results are complete.

    \b
    EXAMPLES
      catstream stop
    """
    return pipeline.stop().reason
