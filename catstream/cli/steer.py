"""`catstream set-box`, `pause`, `resume`, `save` and `stop`: commands to a running pipeline."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from catstream.box import Box
from catstream.steering import Control, control

__all__ = ["pause", "resume", "save", "set_box", "stop"]


def _at_the_helm(command: Callable[..., str]) -> Callable[..., None]:
    """Add `--endpoint`, `--keys` and `--timeout`; the command gets a Control, and what it returns is printed."""

    @click.option(
        "--endpoint", default="", metavar="PLACE", help="Where the pipeline runs; the only one where not given."
    )
    @click.option(
        "--keys", default="", metavar="DIR", help="Folder of the keys that it lets in, where it asks for some."
    )
    @click.option(
        "--timeout", default=5.0, show_default=True, type=click.FloatRange(0), help="Seconds to wait for an answer."
    )
    @wraps(command)
    def wrapped(endpoint: str, keys: str, timeout: float, **options: Any) -> None:
        with control(endpoint, timeout=timeout, keys=keys) as pipeline:
            click.echo(command(pipeline, **options))

    return wrapped


@click.command("set-box", context_settings={"ignore_unknown_options": True})  # -3,40,60,60 is a box
@click.argument("box", metavar="X,Y,W,H")
@click.option("--keep", is_flag=True, help="It is the same object: what was learned of it is kept.")
@_at_the_helm
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
    return pipeline.set_box(Box.of(box), keep=keep).reason


@click.command()
@_at_the_helm
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
@_at_the_helm
def resume(pipeline: Control) -> str:
    """Have a paused pipeline go on.

    \b
    EXAMPLES
      catstream resume
    """
    return pipeline.resume().reason


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@_at_the_helm
def save(pipeline: Control, file: Path) -> str:
    """Write what a running pipeline has learned to FILE.

    It holds the newest model, and a summary of all that it was learned from.
    `catstream track SOURCE --model FILE` finds the object again by it, and goes
    on learning from there. The pipeline goes on meanwhile.

    \b
    EXAMPLES
      catstream save walker.safetensors
      catstream track other.mp4 --model walker.safetensors
    """
    return f"model {pipeline.save(file).version} is in {file}"


@click.command()
@_at_the_helm
def stop(pipeline: Control) -> str:
    """End a running pipeline as if its source had come to its end.

    All that it learned is stored first, and its results are whole.

    \b
    EXAMPLES
      catstream stop
    """
    return pipeline.stop().reason
