"""`catstream sink`: write the tracks of a running pipeline; and the options of destinations, for other commands."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from inspect import cleandoc
from itertools import islice
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from catstream.base.names import split_name
from catstream.base.text import counted, listed
from catstream.cli.attach import wait_for_pipeline, with_address, with_silence_warnings, with_wait
from catstream.cli.common import INTERRUPTS
from catstream.cli.options import PATH, Command, NumberRange, combined, with_overwrite
from catstream.client.address import Address
from catstream.client.attach import REPORT_SECONDS, subscribe
from catstream.errors import SettingsError, SilenceError
from catstream.jobs.job import SinkOptions
from catstream.sinks import destinations
from catstream.sinks import options as sink_options
from catstream.sinks.destinations import SINKS, Head, Origin, TrackedFrame
from catstream.sinks.events import KINDS, check_zones
from catstream.sinks.options import parse_when

_REPORTS = 12  # of all processes, in which one of the detector says what it tracks: those of four seconds


def with_table(rows: Mapping[str, Any]) -> Callable[[Command], Command]:
    """Replace {table} in the help of a command by the lines of the destinations, or of the formats."""

    def changed(command: Command) -> Command:
        lines = (f"  {key:9} {row.meaning}" for key, row in rows.items())
        command.__doc__ = cleandoc(command.__doc__ or "").replace("{table}", "\n".join(["\b", *lines]))
        return command

    return changed


def _zones(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> dict[str, Any]:
    """The corners of the zones by name."""
    zones: dict[str, Any] = {}
    for text in texts:
        name, corners = split_name(text)
        pairs = [corner.split(",") for corner in corners.split()]
        try:
            points = tuple((float(x), float(y)) for x, y in pairs)
        except ValueError:
            points = ()
        if not (name and name not in zones and points):
            raise click.BadParameter(f'expected NAME="X,Y X,Y X,Y ..." with a new name, got {text!r}')
        zones[name] = points
    check_zones(zones)
    return zones


def _when(_: click.Context, __: click.Parameter, text: str) -> tuple[tuple[str, ...], float]:
    """The kinds of events, and the seconds of `lost`."""
    try:
        return parse_when(text)
    except SettingsError as error:
        raise click.BadParameter(str(error)) from None


#: Adds the options of destinations, as the argument `options`, a `SinkOptions`.
with_sink_options = combined(
    "options",
    lambda zone, margin, when, rate, picture, secret, folder, megabytes: SinkOptions(
        *(zone, margin, when[0], when[1], rate, picture),
        secret and secret.absolute(),
        folder and folder.absolute(),
        megabytes,
    ),
    click.option(
        "--zone", multiple=True, metavar='NAME="X,Y X,Y ..."', callback=_zones, help="A polygon in pixels; repeatable."
    ),
    click.option(
        "--zone-margin",
        "margin",
        type=NumberRange(0, 10000),
        default=10,
        metavar="PIXELS",
        help="Hysteresis: an object leaves a zone only farther outside than this; default: 10.",
    ),
    click.option(
        "--when",
        default=",".join(KINDS),
        metavar="EVENT,...",
        callback=_when,
        help=f"Send only these events: {', '.join(KINDS)}; lost=10 after 10 s without a box, default: 2.",
    ),
    click.option(
        "--rate",
        type=NumberRange(0, 1000, min_open=True),
        default=1,
        metavar="N",
        help="States of each object per second, for mqtt://; default: 1.",
    ),
    click.option("--picture", is_flag=True, help="Add the pipeline's newest picture to each event."),
    click.option("--secret-file", "secret", type=PATH, help="File with the key that signs events, for http://."),
    click.option("--events-folder", "folder", type=PATH, metavar="DIR", help="Write a picture of each event to DIR."),
    click.option(
        "--events-megabytes",
        "megabytes",
        type=NumberRange(0, min_open=True),
        default=1000,
        metavar="N",
        help="Size of DIR, above which the oldest files are removed; default: 1000.",
    ),
)


#: Field of `SinkOptions` -> the option that sets it.
_FLAGS = {
    "zones": "--zone",
    "margin": "--zone-margin",
    "events": "--when",
    "lost_seconds": "--when lost=",
    "rate": "--rate",
    "picture": "--picture",
    "key": "--secret-file",
    "folder": "--events-folder",
    "folder_megabytes": "--events-megabytes",
}


def check_options(options: SinkOptions, places: Iterable[str], size: tuple[int, int] | None = None) -> None:
    """Raise UsageError if an option has no effect; with the `size` of a frame, also if a zone is outside."""
    try:
        sink_options.check_options(options, places, size, _FLAGS)
    except SettingsError as error:
        raise click.UsageError(str(error)) from None


def _head(address: Address) -> Head:
    """The head of a log, as far as the detector of the pipeline reports the run."""
    head = Head()
    with subscribe(address, "health", timeout=REPORT_SECONDS) as reports, suppress(SilenceError):
        for report in islice(reports, _REPORTS):
            if report.process == "detector":
                of = report.counters
                head = Head(source=report.source)
                if "width" in of:  # its source is open
                    size, rate, stride = (int(of["width"]), int(of["height"])), of["rate"], int(of["stride"])
                    return replace(head, size=size, rate=rate * stride, start=int(of["start"]), stride=stride)
    return head


@click.command()
@click.argument("places", nargs=-1, metavar="DEST...")
@with_overwrite
@with_sink_options
@with_address
@with_wait
@with_table(SINKS)
def sink(places: tuple[str, ...], overwrite: bool, options: SinkOptions, address: Address, wait: float) -> None:
    """Write the tracks of a running pipeline to each DEST, until it ends or Ctrl-C.

    Each track is written when it arrives. The pipeline does not wait; missed
    tracks are counted. For complete files use `catstream track --output` or
    `--write`. If another run starts at the same endpoint, the command ends.

    {table}

    A video contains the small pictures of the web page. For CVAT, COCO, MOT and
    others: `catstream export`.

    \b
    EXAMPLES
      catstream sink tracks.csv
      catstream sink tracks.ndjson walk.mp4 --endpoint run
      catstream sink - | jq .box
      catstream sink mqtt://10.0.0.7/yard --zone "door=300,80 420,80 420,400 300,400"
      catstream sink https://example.com/hook --when lost=10,entered --secret-file key
    """
    if not (places := (*places, *options.places)):
        raise click.UsageError("missing DEST: pass a file or an address, or --events-folder")
    check_options(options, places)
    for place in places:
        destinations.check_sink(place, options)
        if destinations.is_file(place):
            destinations.check_result(Path(place), overwrite=overwrite)
    written, reason, run = 0, "", ""
    newest: dict[str, int] = {}  # frame of the last track of each object
    address = address.with_endpoint()
    with subscribe(address, "tracks") as tracks:
        with suppress(KeyboardInterrupt), ExitStack() as stack:
            wait_for_pipeline(address, wait)
            origin = Origin(_head(address), address, options, attached=True)
            check_options(options, places, origin.head.size)
            opened = (destinations.open_sink(place, origin) for place in dict.fromkeys(places))
            sinks = [stack.enter_context(closing(sink)) for sink in opened]
            status = stack.enter_context(Console(stderr=True).status("waiting for a track"))
            for track in with_silence_warnings(tracks, partial(destinations.idle, sinks)):
                run = run or tracks.run
                if tracks.run != run and not address.stream:  # a stream of a fleet may move
                    reason = ": the run had no end, and another one started"
                    break
                # A restarted detector repeats some frames; a track that was missed before is not written out of order.
                if track.frame < max(newest.values(), default=-1) or track.frame == newest.get(track.object):
                    continue
                with INTERRUPTS.deferred():  # a track is written everywhere or nowhere
                    for sink in sinks:
                        sink.write(TrackedFrame([track]))
                    written, newest[track.object] = written + 1, track.frame
                status.update(f"frame {track.frame}, {tracks.missed} missed")
        if tracks.end is not None:
            reason = f": {tracks.end.reason}"
        of = f" of {listed(newest)}" if any(newest) else ""
        click.echo(f"{counted(written, 'track')}{of}, {tracks.losses()}{reason}", err=True)
