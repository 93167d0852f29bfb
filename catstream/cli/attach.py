"""The commands that watch and control a running pipeline, and the options that select it."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click
import msgspec
import numpy as np
from rich.console import Console

from catstream.base.box import Box
from catstream.base.clock import STEP_SECONDS, RunningClock
from catstream.base.files import check_file
from catstream.base.names import UNNAMED, check_name, split_name
from catstream.base.text import counted
from catstream.cli.common import complain, screen, table
from catstream.cli.options import (
    FOLDER,
    PATH,
    NumberRange,
    combined,
    with_boxes,
    with_json,
    with_keys,
    with_overwrite,
)
from catstream.client.address import Address
from catstream.client.attach import control, subscribe, wait_until_running
from catstream.client.control import Control
from catstream.client.subscription import Subscription
from catstream.errors import ServiceError, SilenceError
from catstream.jobs.job import Job
from catstream.jobs.state import learned
from catstream.messages.kinds import Health, run_state
from catstream.wire.channels import CHANNELS, PUBLIC

_SILENT_SECONDS = 5.0  # without a message, after which `watch` and `sink` say why
_OLD_SECONDS = 5.0  # age of what is read, from which they say that the reader is slow
_PROCESSES = CHANNELS["health"].senders


def _not_empty(_: click.Context, parameter: click.Parameter, text: str | None) -> str:
    """An option that selects a pipeline: an empty variable of a script must not select the only one that runs."""
    if text == "":
        raise click.BadParameter("is empty: pass a value, or omit the option", param=parameter)
    return text or ""


_with_fleet = click.option(
    "--fleet",
    callback=_not_empty,
    metavar="ADDRESS",
    help="HOST:PORT or name of the fleet; not needed if only one runs here.",
)

#: Adds the options that select a fleet by its registry, as an `Address` without a stream: the argument `address`.
with_fleet_address = combined("address", lambda fleet, keys: Address(fleet=fleet, keys=keys), _with_fleet, with_keys)


def _address(endpoint: str, stream: str, fleet: str, keys: str, source: str = "") -> Address:
    if endpoint and (stream or fleet):
        raise click.UsageError("--endpoint (a pipeline) and --stream, --fleet (a stream) are mutually exclusive")
    if source and (endpoint or stream):
        raise click.UsageError("--source is mutually exclusive with --endpoint and --stream")
    if fleet and not stream:
        raise click.UsageError("--fleet requires --stream NAME")
    return Address(stream=stream, fleet=fleet, keys=keys) if stream else Address.parse(endpoint, keys, source)


_OPTIONS = (
    click.option(
        "--endpoint",
        callback=_not_empty,
        metavar="PLACE",
        help="Endpoint of the pipeline; not needed if only one runs.",
    ),
    click.option("--stream", callback=_not_empty, metavar="NAME", help="A stream of a fleet, instead of --endpoint."),
    _with_fleet,
    with_keys,
)

#: Adds the options that select a running pipeline or a stream of a fleet, as the argument `address`.
with_address = combined(
    "address", lambda endpoint, stream, fleet, keys: _address(endpoint, stream, fleet, keys), *_OPTIONS
)

#: The same, and `--source`.
_with_address_or_source = combined(
    "address",
    _address,
    *_OPTIONS,
    click.option(
        "--source",
        callback=_not_empty,
        metavar="SOURCE",
        help="Select the pipeline by its source instead of --endpoint.",
    ),
)

with_wait = click.option(
    "--wait",
    type=NumberRange(0),
    default=30.0,
    show_default=True,
    metavar="SECONDS",
    help="Seconds to wait for the pipeline at --endpoint.",
)


def wait_for_pipeline(address: Address, seconds: float) -> None:
    """Wait until a process of the pipeline answers; a terminal shows a status line."""
    with Console(stderr=True).status(f"waiting for a pipeline at {address}"):
        wait_until_running(address, seconds)


@click.command()
@click.argument("channel", type=click.Choice(list(PUBLIC)))
@with_address
@with_wait
@click.option("--object", "name", metavar="NAME", help="Only the tracks, models or samples of this object.")
@click.option("--json", "as_json", is_flag=True, help="Print each message as a line of JSON.")
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
      catstream watch tracks --stream cam-7 --fleet head:5690 --keys anna
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
        click.echo(f"{received} {channel}, {messages.losses()}{reason}", err=True)


def with_silence_warnings(messages: Subscription[Any], idle: Callable[[], None] = lambda: None) -> Iterator[Any]:
    """Yield the messages; warn if they are old, and if none arrives, once for each reason, and call `idle` then."""
    messages.timeout, reason, old = _SILENT_SECONDS, "", False
    while True:
        try:
            for message in messages:
                reason = ""
                if not old and messages.behind >= _OLD_SECONDS:
                    old = True
                    click.echo(f"lagging {messages.behind:.0f} s behind: this subscriber is too slow", err=True)
                yield message
            return
        except SilenceError as error:
            idle()
            before, reason = reason, re.sub(r"\d+", "", str(error))  # seconds that pass are no other reason
            if reason != before:
                click.echo(f"waiting: {error}", err=True)


def _described(value: bytes | np.ndarray) -> dict[str, object]:
    """Return a description of a picture or an array, for which JSON has no form."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    norm = float(np.linalg.norm(np.nan_to_num(value)))
    return {"dtype": value.dtype.name, "shape": list(value.shape), "norm": round(norm, 6)}


def _line(value: Any) -> str:
    """The fields of a message that are not empty, after their names; the fields of a nested message in brackets."""
    if isinstance(value, dict):
        texts = {name: _line(field) for name, field in value.items()}
        texts |= {name: f"({text})" for name, text in texts.items() if isinstance(value[name], dict)}
        return "  ".join(f"{name} {text}" for name, text in texts.items() if text not in ("", "()"))
    if isinstance(value, list | tuple):
        return ",".join(map(_line, value))
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return "" if value is None else str(round(value, 4) if isinstance(value, float) else value)


@click.command()
@_with_address_or_source
@with_json
@click.option(
    "--wait", default=3.0, show_default=True, type=NumberRange(0), help="Maximum seconds to wait for health reports."
)
def status(address: Address, as_json: bool, wait: float) -> None:
    """Show the state of a running pipeline.

    The state is running, waiting (for a box), paused, or lost (the source). The
    exit status is 0 if all three processes sent a health report, else 1, so that
    the command can be the health check of a container.

    "learning" is the backlog: messages that the compressor has not received or
    not stored; "rejected" counts invalid messages; "reports" is the age of the
    last health report of each process.

    \b
    EXAMPLES
      catstream status
      catstream status --source walk.mp4
      catstream status --endpoint run --json
    """
    address = address.with_endpoint()
    reports = _collect_reports(address, wait)
    summary = _summary(str(address), reports)
    if as_json:
        click.echo(json.dumps(summary))
    elif reports:
        click.echo(_format(summary))
        if any(summary["objects"]):  # they have names
            figures = ("state", "score", "model", "leaves")
            objects = table("object", *figures, right=figures)
            for name, cells in summary["objects"].items():
                objects.add_row(name or "-", *("-" if cell is None else str(cell) for cell in cells.values()))
            screen().print("", objects, sep="\n")
    if silent := [name for name in _PROCESSES if name not in reports]:
        problem = "" if reports else f": {address.resolve().hint()}"
        complain(f"no health report at {address} within {wait:g} s from: {', '.join(silent)}{problem}")
        sys.exit(1)


def _collect_reports(address: Address, seconds: float) -> dict[str, list[Health]]:
    """Collect reports, oldest first, until there are two of the detector, for its rate, and one of the others."""
    clock, reports = RunningClock(), dict[str, list[Health]]()
    with subscribe(address, "health") as health:
        while len(reports) < len(_PROCESSES) or len(reports["detector"]) < 2:
            if (remaining := seconds - clock()) <= 0:
                break
            health.timeout = min(remaining, STEP_SECONDS)
            with suppress(SilenceError):
                if (report := next(health, None)) is None:
                    break
                reports.setdefault(report.process, []).append(report)
    return reports


def _summary(endpoint: str, reports: dict[str, list[Health]]) -> dict[str, Any]:
    """Return the figures from the reports, None for those that are missing."""
    newest = {name: history[-1] for name, history in reports.items()}
    counters = {name: newest[name].counters if name in newest else {} for name in _PROCESSES}
    objects = {name: newest[name].objects if name in newest else {} for name in _PROCESSES}
    detector, history = counters["detector"], reports.get("detector", [])
    seconds = history[-1].time - history[0].time if history else 0.0
    rate = (history[-1].counters["sent"] - history[0].counters["sent"]) / seconds if seconds > 0 else None

    def whole(process: str, *names: str) -> dict[str, int | None]:
        own = counters[process]
        return {name: int(own[name]) if name in own else None for name in names}

    return {
        "endpoint": endpoint,
        "ok": len(reports) == len(_PROCESSES),
        "state": newest["detector"].state if detector else None,
        "objects": {
            name: {
                "state": ("present" if figures["present"] else "absent") if "present" in figures else None,
                "score": round(figures["score"], 2) if "score" in figures else None,
                "model_version": int(figures["model_version"]),
                "leaves": int(objects["compressor"][name]["leaves"]) if name in objects["compressor"] else None,
            }
            for name, figures in objects["detector"].items()
        },
        "frames": whole("detector", "sent")["sent"],
        "frames_per_second": None if rate is None else round(max(0.0, rate), 1),  # that of a restarted detector falls
        "lag": int(detector["sent"] - detector["processed"]) if detector else None,
        "not_stored": int(detector["sent"] - detector["stored"]) if detector else None,
        **whole("detector", "model_version"),
        **whole("compressor", "level", "leaves", "nodes", "bytes"),
        **whole("detector", "skipped", "reconnects"),
        "lost_seconds": detector.get("lost_seconds"),
        "trouble": {name: report.trouble for name, report in newest.items() if report.trouble},
        "rejected": {name: int(counters[name].get("rejected", 0)) for name in reports},
        "processes": {
            name: {"seconds_ago": round(max(0.0, time.time() - report.time), 2), "counters": report.counters}
            for name, report in newest.items()
        },
    }


def _format(summary: dict[str, Any]) -> str:
    at = {name: "-" if value is None else value for name, value in summary.items()}
    size = (summary["bytes"] or 0) / 1e6
    lines = {
        "pipeline": at["endpoint"],
        "state": run_state(summary["processes"]["detector"]["counters"])[1] if summary["state"] else "-",
        "frames": f"{at['frames']}, {at['frames_per_second']} a second",
        "learning": f"{at['lag']} messages behind, {at['not_stored']} not stored",
        "model": at["model_version"],
    }
    if summary["bytes"] is not None:  # None before the first box
        lines["trees"] = f"{at['leaves']} leaves, {at['nodes']} nodes, level {at['level']}, {size:.1f} MB"
    if summary["skipped"] is not None:  # None for a file
        lines["source"] = f"{counted(summary['skipped'], 'frame')} skipped"
        if summary["reconnects"] is not None:  # a demo is never lost
            lines["source"] += f", {counted(summary['reconnects'], 'reconnect')}"
    lines["rejected"] = counted(sum(summary["rejected"].values()), "message")
    lines["reports"] = ", ".join(f"{name} {of['seconds_ago']:.1f} s ago" for name, of in summary["processes"].items())
    if summary["trouble"]:
        lines["trouble"] = "; ".join(f"{name}: {trouble}" for name, trouble in summary["trouble"].items())
    return "\n".join(f"{name:10} {line}" for name, line in lines.items())


@dataclass(frozen=True, slots=True)
class _Target:
    """The pipeline that a command is for, as given by the options."""

    address: Address
    timeout: float
    yes: bool

    @property
    def is_named(self) -> bool:
        return bool(str(self.address) or self.address.source)

    def control(self) -> Control:
        """Connect to the pipeline and print its name. At a terminal, ask for confirmation if it was not named."""
        pipeline = control(self.address, timeout=self.timeout)
        line = f"pipeline: {pipeline.source or 'a pipeline'} at {pipeline.endpoint}"
        if str(self.address) and not pipeline.source:
            pass  # there is nothing to say beside the endpoint
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
    _with_address_or_source,
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
@with_boxes
@click.option("--keep", is_flag=True, help="Correct the same object: keep its model.")
@_with_control
def set_box(pipeline: Control, boxes: dict[str, Box], keep: bool) -> str:
    """Set the box of an object, or of several, in a running pipeline.

    X,Y,W,H is the box in pixels in the next frame; while a file is paused, in
    the frame at which it is held. A new NAME adds an object; an existing one is
    replaced, and its model is dropped. NAME may be omitted if there is only one
    object. Several objects begin in the same frame, or, if a box is invalid, none.

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
@click.option("--state", type=FOLDER, metavar="FOLDER", help="State folder of a run, which may have ended.")
@with_overwrite
@_with_pipeline
def save(target: _Target, file: Path, state: Path | None, name: str, overwrite: bool) -> None:
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
        with target.control() as pipeline:
            version = pipeline.save(file, name).version
    elif target.is_named:
        raise click.UsageError(
            "--state (the folder of a run) is mutually exclusive with --endpoint, --stream and --source"
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
