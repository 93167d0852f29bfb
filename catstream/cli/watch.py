"""`catstream watch`: print the messages of a running pipeline."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from functools import partial
from typing import Any, Self

import click
import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from catstream.box import Box
from catstream.cli.attach import wait_for_pipeline, with_endpoint, with_wait
from catstream.cli.output import table
from catstream.client.subscription import Subscription
from catstream.messages.heads import APPEARANCE, GROUPS, TREES
from catstream.messages.kinds import Features, Health, Model, Preview, Sample, Track

_RATE_SECONDS = 2.0  # interval of the mean rate
_ROWS = 16  # number of messages that a terminal shows
_REFRESHES = 8  # per second
_LEFT = {"object", "state", "process", "counters", "levels"}  # left-aligned columns


def _track(message: Track) -> dict[str, str]:
    return _object(message) | {
        "frame": f"{message.frame}",
        "seconds": f"{message.time:.2f}",
        "state": message.state,
        "box": _sides(message.box),
        "score": f"{message.score:+.2f}",
        "model": f"{message.model_version}",
    }


def _object(message: Track | Model | Sample) -> dict[str, str]:
    """The cell of the object's name, if it has one."""
    return {"object": message.object} if message.object else {}


def _sides(box: Box | None) -> str:
    return "-" if box is None else ", ".join(f"{side:.0f}" for side in box)


def _model(message: Model) -> dict[str, str]:
    return _object(message) | {
        "version": f"{message.version}",
        "frame": f"{message.frame}",
        "|weights|": f"{np.linalg.norm(message.weights):.3f}",
        "bias": f"{message.bias:+.3f}",
        "motion": "no" if message.motion is None else "yes",
        "heads": " ".join(message.heads) or "-",
    }


def _sample(message: Sample) -> dict[str, str]:
    trees = {name: message.trees.get(name) for name in TREES}
    return _object(message) | {
        "version": f"{message.version}",
        "frame": f"{message.frame}",
        "levels": " ".join(map(str, message.trees["object"].levels)),
        **{name: "-" if tree is None else f"{len(tree.rows)} of {tree.count}" for name, tree in trees.items()},
    }


def _features(message: Features) -> dict[str, str]:
    rows = [part.training for part in message.objects.values()]
    labels = np.concatenate([np.empty(0), *(each[APPEARANCE].labels for each in rows if APPEARANCE in each)])
    objects, background = int((labels == 1).sum()), int((labels == 0).sum())
    return {
        "frame": f"{message.frame}",
        "objects": f"{len(message.objects)}",
        "object": f"{objects}",
        "background": f"{background}",
        "near misses": f"{len(labels) - objects - background}",
        **{name: f"{sum(len(each.get(name, ())) for each in rows)}" for name in GROUPS},
    }


def _preview(message: Preview) -> dict[str, str]:
    return {
        "frame": f"{message.frame}",
        "size": f"{message.width} x {message.height}",
        "objects": " ".join(f"{name or '-'}:{_sides(box)}" for name, box in message.boxes.items()) or "-",
        "bytes": f"{len(message.jpeg)}",
    }


def _health(message: Health) -> dict[str, str]:
    counters = (f"{name} {value:.0f}" for name, value in message.counters.items())
    return {"process": message.process, "counters": "  ".join(counters)}


#: Channel -> function that returns the cells of a message by the names of their columns.
_CELLS: dict[str, Callable[[Any], dict[str, str]]] = {
    "tracks": _track,
    "models": _model,
    "health": _health,
    "samples": _sample,
    "features": _features,
    "previews": _preview,
}


@click.command()
@click.argument("channel", type=click.Choice(list(_CELLS)))
@with_endpoint
@with_wait
@click.option("--object", "name", metavar="NAME", help="Only the tracks, models or samples of this object.")
@click.option("--json", "as_json", is_flag=True, help="Print each message as a line of JSON.")
@click.option("--count", type=click.IntRange(min=1), help="End after this number of messages.")
def watch(
    channel: str, endpoint: str, keys: str, wait: float, name: str | None, as_json: bool, count: int | None
) -> None:
    """Print the messages of a running pipeline, until it ends or Ctrl-C.

    The pipeline does not wait; messages that are dropped because this command
    is too slow are counted as missed. With --json, an array is printed as its
    dtype, shape and norm.

    \b
    CHANNEL
      tracks    state and box of each object in each frame
      models    the last model of each object, then each new one
      health    the counters of each process, every second
      samples   the samples for the trainer, and the levels of the object's tree
      features  the training rows of each frame
      previews  small pictures of the newest frame, about ten per second

    \b
    EXAMPLES
      catstream watch tracks
      catstream watch tracks --json | jq .box
      catstream watch tracks --object anna
      catstream watch models --endpoint run --count 1 --json
      catstream watch tracks --stream cam-7
      catstream watch tracks --stream cam-7 --fleet head:5690 --keys anna
    """
    seen = 0
    with Subscription[Any](endpoint, channel, object=name, keys=keys) as messages:
        with suppress(KeyboardInterrupt), ExitStack() as stack:
            wait_for_pipeline(messages.endpoint, messages.keys, wait)
            if as_json:
                show = _print_json
            elif Console().is_terminal:
                show = stack.enter_context(_Screen(channel, messages)).add
            else:
                show = partial(_print_line, channel)
            for message in messages:
                show(message)
                seen += 1
                if seen == count:
                    break
        reason = f": {messages.end.reason}" if messages.end is not None else ""
        click.echo(f"{seen} {channel}, {messages.losses()}{reason}", err=True)


def _print_json(message: Any) -> None:
    click.echo(json.dumps(asdict(message), default=_described))


def _described(value: bytes | np.ndarray) -> dict[str, object]:
    """Return a description of a picture or an array, for which JSON has no form."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    norm = float(np.linalg.norm(np.nan_to_num(value)))
    return {"dtype": value.dtype.name, "shape": value.shape, "norm": round(norm, 6)}


def _print_line(channel: str, message: object) -> None:
    click.echo("  ".join(f"{name} {cell}" for name, cell in _CELLS[channel](message).items()))


class _Screen:
    """A table of the newest messages, of health the newest of each process, redrawn in a thread of its own."""

    def __init__(self, channel: str, messages: Subscription[Any]) -> None:
        self._cells, self._messages = _CELLS[channel], messages
        # Replaced, never changed: the thread reads them.
        self._rows: dict[object, dict[str, str]] = {}
        self._moments: tuple[float, ...] = ()
        self._live = Live(get_renderable=self._draw, refresh_per_second=_REFRESHES)

    def add(self, message: object) -> None:
        self._moments = (*self._recent(), time.monotonic())
        key = message.process if isinstance(message, Health) else object()
        rows = {**self._rows, key: self._cells(message)}
        self._rows = {key: rows[key] for key in list(rows)[-_ROWS:]}

    def _recent(self) -> list[float]:
        now = time.monotonic()
        return [moment for moment in self._moments if now - moment <= _RATE_SECONDS]

    def _draw(self) -> Group:
        rows = list(self._rows.values())
        columns: dict[str, str] = max(rows, key=len, default={})  # rows of objects without a name have no cell for it
        shown = table(*columns, right=columns.keys() - _LEFT)
        for cells in rows:
            shown.add_row(*(cells.get(name, "-") for name in columns))
        rate = len(self._recent()) / _RATE_SECONDS
        line = f"{rate:.0f} a second   {self._messages.missed} missed   {self._messages.endpoint}"
        return Group(shown, Text(line, style="dim"))

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
