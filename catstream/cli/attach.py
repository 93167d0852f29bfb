"""The commands that watch and control a running pipeline, and the options that select it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any

import click
import msgspec
import numpy as np

from catstream.base.box import Box
from catstream.base.files import check_file
from catstream.base.names import UNNAMED, check_name, split_name
from catstream.base.text import counted
from catstream.cli.options import FOLDER, PATH, NumberRange, combined, with_boxes, with_json, with_keys, with_overwrite
from catstream.client.address import Address
from catstream.client.attach import control, subscribe, wait_until_running
from catstream.client.control import Control
from catstream.client.subscription import REASON_SECONDS, Subscription
from catstream.errors import SilenceError
from catstream.processes.job import Job
from catstream.processes.state import learned
from catstream.wire.channels import PUBLIC

_SILENT_SECONDS = 3 * REASON_SECONDS  # without a message, after which `watch` and `sink` print the reason
_OLD_SECONDS = 5.0  # age of a message from which they warn that they lag


def _not_empty(_: click.Context, parameter: click.Parameter, text: str | None) -> str:
    """Reject an empty value: an empty variable of a script must not select the only running pipeline."""
    if text == "":
        raise click.BadParameter("is empty: pass a value, or omit the option", param=parameter)
    return text or ""


#: Adds the options that select a fleet by its registry, as an `Address` without a stream: the argument `address`.
with_fleet_address = combined(
    "address",
    lambda fleet, keys: Address(fleet=fleet, keys=keys),
    click.option(
        "--fleet",
        callback=_not_empty,
        metavar="ADDRESS",
        help="HOST:PORT or name of the fleet; not needed if only one runs here.",
    ),
    with_keys,
)

#: Adds the options that select a running pipeline or a stream of a fleet, as the argument `address`.
with_address = combined(
    "address",
    lambda endpoint, keys: Address.parse(endpoint, keys),
    click.option(
        "--endpoint",
        callback=_not_empty,
        metavar="PLACE",
        help="Folder or address of the pipeline, or fleet://STREAM; not needed if only one runs.",
    ),
    with_keys,
)

with_wait = click.option(
    "--wait", default=30.0, show_default=True, type=NumberRange(0), help="Seconds to wait for a pipeline at --endpoint."
)


def wait_for_pipeline(address: Address, seconds: float) -> None:
    """Wait until a process of the pipeline answers; show a status line on a terminal."""
    from rich.console import Console

    with Console(stderr=True).status(f"waiting for a pipeline at {address}"):
        wait_until_running(address, seconds)


@click.command()
@click.argument("channel", type=click.Choice(list(PUBLIC)))
@with_address
@with_wait
@click.option("--object", "name", metavar="NAME", help="Only the tracks, models or samples of this object.")
@with_json
@click.option("--count", type=click.IntRange(min=1), help="End after this number of messages.")
def watch(channel: str, address: Address, wait: float, name: str | None, as_json: bool, count: int | None) -> None:
    """Print the messages of a running pipeline, one a line, until it ends or Ctrl-C.

    The pipeline does not wait; messages that are dropped because this command
    is too slow are counted as missed. An array is printed as its dtype, shape
    and norm.

    \b
    CHANNEL
      tracks    state and box of each object in each frame
      models    the last model of each object, then each new one
      health    the counters of each process, every second
      samples   the samples for the trainer
      features  the training rows of each frame
      previews  small pictures of the newest frame

    \b
    EXAMPLES
      catstream watch tracks
      catstream watch tracks --json | jq .box
      catstream watch tracks --object anna
      catstream watch models --endpoint run --count 1 --json
      catstream watch tracks --endpoint fleet://head:5690/cam-7 --keys anna
    """
    received = 0
    address = address.with_endpoint()
    with subscribe(address, channel, object=name) as messages:
        with suppress(KeyboardInterrupt):
            wait_for_pipeline(address, wait)
            for message in with_silence_warnings(messages):
                fields = msgspec.to_builtins(message, builtin_types=(bytes,), enc_hook=_described)
                click.echo(json.dumps(fields, default=_described) if as_json else _line(fields))
                received += 1
                if received == count:
                    break
        reason = f": {messages.end.reason}" if messages.end is not None else ""
        click.echo(f"{counted(received, 'message')}, {messages.losses()}{reason}", err=True)


def with_silence_warnings(messages: Subscription[Any], idle: Callable[[], None] = lambda: None) -> Iterator[Any]:
    """Yield the messages; warn once if they are old, and once per reason for silence; call `idle` during a silence."""
    messages.timeout, reason, old, silent = REASON_SECONDS, "", False, 0.0
    while True:
        try:
            for message in messages:
                reason, silent = "", 0.0
                if not old and messages.behind >= _OLD_SECONDS:
                    old = True
                    click.echo(f"lagging {messages.behind:.0f} s behind: this subscriber is too slow", err=True)
                yield message
            return
        except SilenceError as error:
            idle()
            silent += REASON_SECONDS
            if silent < _SILENT_SECONDS:
                continue
            before, reason = (
                reason,
                re.sub(r"\d+", "", str(error)),
            )  # the number of seconds does not make another reason
            if reason != before:
                click.echo(f"waiting: {str(error).replace(f'{REASON_SECONDS:g} s', f'{silent:g} s', 1)}", err=True)


def _described(value: bytes | np.ndarray) -> dict[str, object]:
    """Describe a picture or an array, which JSON cannot represent."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    norm = float(np.linalg.norm(np.nan_to_num(value)))
    return {"dtype": value.dtype.name, "shape": list(value.shape), "norm": round(norm, 6)}


def _line(value: Any) -> str:
    """Names and values of the non-empty fields of a message; a nested message is in brackets."""
    if isinstance(value, dict):
        texts = {name: _line(field) for name, field in value.items()}
        texts |= {name: f"({text})" for name, text in texts.items() if isinstance(value[name], dict)}
        return "  ".join(f"{name or '-'} {text}" for name, text in texts.items() if text not in ("", "()"))
    if isinstance(value, list | tuple):
        return ",".join(map(_line, value))
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return "" if value is None else str(round(value, 4) if isinstance(value, float) else value)


def _control(address: Address, timeout: float) -> Control:
    """Connect to a pipeline, and print its source and endpoint."""
    pipeline = control(address, timeout=timeout)
    if pipeline.source:
        click.echo(f"pipeline: {pipeline.source} at {pipeline.endpoint}", err=True)
    return pipeline


_with_timeout = click.option(
    "--timeout", default=5.0, show_default=True, type=NumberRange(0), help="Seconds to wait for an answer."
)


def _with_control(command: Callable[..., str]) -> Callable[..., None]:
    """Add the options that select a pipeline; the command receives a `Control`, and its return value is printed."""

    @with_address
    @_with_timeout
    @wraps(command)
    def wrapped(address: Address, timeout: float, **options: object) -> None:
        with _control(address, timeout) as pipeline:
            click.echo(command(pipeline, **options))

    return wrapped


@click.command("set-box", context_settings={"ignore_unknown_options": True})  # -3,40,60,60 is a box
@with_boxes
@click.option("--keep", is_flag=True, help="Correct the same object: keep its model.")
@_with_control
def set_box(pipeline: Control, boxes: dict[str, Box], keep: bool) -> str:
    """Set the box of an object, or of several, in a running pipeline.

    X,Y,W,H is the box in pixels in the next frame; while a file is paused, in
    the frame at which it is paused. A new NAME adds an object; an existing one is
    replaced, and its model is dropped. NAME may be omitted if there is only one
    object. Several objects begin in the same frame; an invalid box rejects all.

    \b
    EXAMPLES
      catstream set-box 120,80,64,48
      catstream set-box anna=120,80,64,48 ben=300,90,60,150
      catstream set-box anna=118,83,64,48 --keep
    """
    if len(boxes) > 1 and keep:
        raise click.UsageError("--keep is for one box: set the boxes one after the other")
    if len(boxes) > 1:
        return pipeline.set_boxes(boxes).reason
    ((name, box),) = boxes.items()
    return pipeline.set_box(box, name, keep=keep).reason


@click.command()
@click.argument("file", metavar="[NAME=]FILE")
@_with_control
def search(pipeline: Control, file: str) -> str:
    """Search for the object of a saved model in a running pipeline.

    The object is absent until it is found in the whole frame; training continues
    from FILE, written by `catstream save`. An existing object NAME is replaced.
    NAME may be omitted if there is only one object.

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

    Its model and coreset trees are dropped. NAME may be omitted if there is only
    one object. Without any object, the run waits for `catstream set-box`.

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
@click.option("--state", type=FOLDER, metavar="DIR", help="State folder of a run, which may have ended.")
@with_overwrite
@with_address
@_with_timeout
def save(address: Address, timeout: float, file: Path, state: Path | None, name: str, overwrite: bool) -> None:
    """Save the model and the coreset trees of an object to FILE.

    `catstream track SOURCE --model FILE` finds the object and continues its
    training. With --state, the newest checkpoint in that folder is saved, without
    a running pipeline.

    \b
    EXAMPLES
      catstream save walker.safetensors
      catstream save anna.safetensors --object anna
      catstream save walker.safetensors --state checkpoints
    """
    check_file(file, overwrite=overwrite)
    if state is None:
        with _control(address, timeout) as pipeline:
            version = pipeline.save(file, name).version
    elif str(address):
        raise click.UsageError("--state (the folder of a run) and --endpoint are mutually exclusive")
    else:
        saved = learned(state, Job.load(state).settings, check_name(name))
        saved.save(file)
        version = saved.model.version
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
