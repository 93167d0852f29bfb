"""`catstream set-box`, `pause`, `resume`, `save` and `stop`: commands to a running pipeline."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click

from catstream.box import Box
from catstream.cli.attach import with_endpoint
from catstream.errors import ServiceError
from catstream.job import Job
from catstream.state import learned
from catstream.steering import Control, control

__all__ = ["pause", "resume", "save", "set_box", "stop"]


@dataclass(frozen=True, slots=True)
class _Meant:
    """The pipeline that a command is for, as the options say it.

    yes  whether a person who named none agrees to the only one
    """

    endpoint: str
    source: str
    keys: str
    timeout: float
    yes: bool

    @property
    def named(self) -> bool:
        return bool(self.endpoint or self.source)

    def control(self) -> Control:
        """Connect to it and say which one it is; a person at a terminal who named none is asked first."""
        pipeline = control(self.endpoint, timeout=self.timeout, keys=self.keys, source=self.source)
        line = f"pipeline: {pipeline.source or 'a pipeline'} at {pipeline.endpoint}"
        if self.endpoint and not pipeline.source:
            return pipeline  # nothing is known of it but what was said
        if self.named or self.yes or not sys.stdin.isatty():
            click.echo(line, err=True)
        elif not click.confirm(f"{line}. Is it the one that you mean?", default=True, err=True):
            pipeline.close()
            raise ServiceError("nothing was done: name the pipeline with --endpoint or --source")
        return pipeline


def _with_pipeline(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say which pipeline is meant; the command gets them as one argument `meant`."""

    @with_endpoint
    @click.option("--source", default="", metavar="SOURCE", help="The source that it follows, instead of --endpoint.")
    @click.option(
        "--timeout", default=5.0, show_default=True, type=click.FloatRange(0), help="Seconds to wait for an answer."
    )
    @click.option("--yes", is_flag=True, help="Do not ask whether the only pipeline that runs is the one meant.")
    @wraps(command)
    def wrapped(endpoint: str, source: str, keys: str, timeout: float, yes: bool, **options: Any) -> None:
        if endpoint and source:
            raise click.UsageError("--endpoint and --source both say which pipeline is meant: give one of them")
        command(meant=_Meant(endpoint, source, keys, timeout, yes), **options)

    return wrapped


def _steers(command: Callable[..., str]) -> Callable[..., None]:
    """Add the same; the command gets a Control, and what it returns is printed."""

    @_with_pipeline
    @wraps(command)
    def wrapped(meant: _Meant, **options: Any) -> None:
        with meant.control() as pipeline:
            click.echo(command(pipeline, **options))

    return wrapped


@click.command("set-box", context_settings={"ignore_unknown_options": True})  # -3,40,60,60 is a box
@click.argument("box", metavar="X,Y,W,H")
@click.option("--keep", is_flag=True, help="It is the same object: what was learned of it is kept.")
@_steers
def set_box(pipeline: Control, box: str, keep: bool) -> str:
    """Tell a running pipeline where the object is.

    X,Y,W,H is its box in the newest frame, in pixels; while the pipeline is
    paused or waits for a box, in the frame that is held. What was learned of
    another object before is forgotten.

    \b
    EXAMPLES
      catstream set-box 120,80,64,48
      catstream set-box 118,83,64,48 --keep
    """
    return pipeline.set_box(Box.parse(box), keep=keep).reason


@click.command()
@_steers
def pause(pipeline: Control) -> str:
    """Have a running pipeline take no more frames.

    A file waits; the frames of a camera or a stream pass by and are counted as
    skipped. `catstream resume` goes on.

    \b
    EXAMPLES
      catstream pause
      catstream pause --endpoint run
    """
    return pipeline.pause().reason


@click.command()
@_steers
def resume(pipeline: Control) -> str:
    """Have a paused pipeline go on.

    \b
    EXAMPLES
      catstream resume
    """
    return pipeline.resume().reason


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--state", type=click.Path(path_type=Path), metavar="FOLDER", help="Of a run with --state; it may be over."
)
@_with_pipeline
def save(meant: _Meant, file: Path, state: Path | None) -> None:
    """Write what a pipeline has learned to FILE.

    It holds the newest model, and a summary of all that it was learned from.
    `catstream track SOURCE --model FILE` finds the object again by it, and goes
    on learning from there. A pipeline that runs goes on meanwhile.

    With --state it is what the newest checkpoint in that folder holds, and no
    pipeline has to run. A run without such a folder writes the same file at its
    end with `catstream track --save-model FILE`.

    \b
    EXAMPLES
      catstream save walker.safetensors
      catstream save walker.safetensors --state kept
      catstream track other.mp4 --model walker.safetensors
    """
    if state is None:
        with meant.control() as pipeline:
            version = pipeline.save(file).version
    elif meant.named:
        raise click.UsageError(
            "--state names the folder of a run, --endpoint and --source a running pipeline: give one"
        )
    else:
        found = learned(state, Job.load(state).settings)
        found.save(file)
        version = found.model.version
    click.echo(f"model {version} is in {file}")


@click.command()
@_steers
def stop(pipeline: Control) -> str:
    """End a running pipeline as if its source had come to its end.

    All that it learned is stored first, and its results are whole.

    \b
    EXAMPLES
      catstream stop
    """
    return pipeline.stop().reason
