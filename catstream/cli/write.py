"""`catstream sink`: write the tracks of a running pipeline."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import wraps
from inspect import cleandoc
from itertools import islice
from typing import Any

import click
from rich.console import Console

from catstream.base.names import split_name
from catstream.base.text import counted, listed
from catstream.cli.attach import wait_for_pipeline, with_address, with_silence_warnings, with_wait
from catstream.cli.common import INTERRUPTS
from catstream.cli.options import Command
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.errors import SettingsError, SilenceError
from catstream.output.destinations import SINKS, Header, Origin, TrackedFrame
from catstream.output.events import check_zones
from catstream.output.options import OPTIONS, parse
from catstream.output.track_log import RunFiles
from catstream.wire.commands import ANSWER_SECONDS

_REPORTS = 12  # health reports of all processes in four seconds, one of which is from the detector


def with_table(rows: Mapping[str, Any]) -> Callable[[Command], Command]:
    """Replace {table} in the help of a command by a table of destinations or formats."""

    def changed(command: Command) -> Command:
        lines = (f"  {key:9} {row.meaning}" for key, row in rows.items())
        command.__doc__ = cleandoc(command.__doc__ or "").replace("{table}", "\n".join(["\b", *lines]))
        return command

    return changed


def _texts(_: click.Context, __: click.Parameter, pairs: tuple[str, ...]) -> dict[str, str] | None:
    """The texts NAME=TEXT by name, or None."""
    texts = dict(map(split_name, pairs))
    if "" in texts or len(texts) < len(pairs):
        raise click.BadParameter(f"expected NAME=TEXT, each with a new name, got {pairs[-1]!r}")
    return texts or None


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _with_options(command: Command) -> Command:
    """Add the options of destinations, as the argument `values`: a dict of the passed ones by name."""

    @wraps(command)
    def wrapped(**arguments: Any) -> object:
        values = {name: arguments.pop(name) for name in OPTIONS}
        return command(values={name: value for name, value in values.items() if value is not None}, **arguments)

    whole: Command = wrapped
    for name, option in reversed(OPTIONS.items()):
        if option.kind is bool:
            add = click.option(_flag(name), is_flag=True, default=None, help=option.help)
        elif option.kind == dict[str, str]:
            add = click.option(_flag(name), multiple=True, metavar=option.metavar, callback=_texts, help=option.help)
        else:
            add = click.option(_flag(name), metavar=option.metavar, help=option.help)
        whole = add(whole)
    return whole


def _header(address: Address) -> Header:
    """The header of a log, from the health reports of the detector."""
    header = Header()
    with subscribe(address, "health", timeout=ANSWER_SECONDS) as reports, suppress(SilenceError):
        for report in islice(reports, _REPORTS):
            if report.process == "detector":
                of = report.counters
                header = Header(source=report.source)
                if "width" in of:  # its source is open
                    size, rate, stride = (int(of["width"]), int(of["height"])), of["rate"], int(of["stride"])
                    return replace(header, size=size, rate=rate * stride, start=int(of["start"]), stride=stride)
    return header


@click.command()
@click.argument("destinations", nargs=-1, required=True, metavar="DEST...")
@_with_options
@with_address
@with_wait
@with_table(SINKS)
def sink(destinations: tuple[str, ...], values: dict[str, Any], address: Address, wait: float) -> None:
    """Write the tracks of a running pipeline to each DEST, until it ends or Ctrl-C.

    Each track is written when it arrives. The pipeline does not wait; missed
    tracks are counted. For complete files use `catstream track --output` or
    `--write`. If another run starts at the same endpoint, the command ends. An
    existing file is renamed, as tracks-20261128T133015.csv by its last change.

    {table}

    A video contains the small pictures of the web page. For CVAT, COCO, MOT and
    others: `catstream export`.

    \b
    EXAMPLES
      catstream sink tracks.csv
      catstream sink tracks.ndjson walk.mp4 --endpoint run
      catstream sink - | jq .box
      catstream sink mqtt://10.0.0.7/yard --zone "door=300,80 420,80 420,400 300,400"
      catstream sink https://example.com/hook events/ --when lost=10,entered
    """
    # Step 1: check the options and the destinations.
    try:
        options = parse(values, destinations, _flag)
    except SettingsError as error:
        raise click.UsageError(str(error)) from None
    files = RunFiles(Origin(options=options), None, [*dict.fromkeys(destinations)])
    files.check(overwrite=True, earlier=[])
    received, not_written, reason, run = 0, 0, "", ""
    newest: dict[str, int] = {}  # frame of the last track of each object
    address = address.with_endpoint()
    with subscribe(address, "tracks") as tracks:
        with suppress(KeyboardInterrupt), ExitStack() as stack:
            # Step 2: wait for the pipeline, whose reports have the header of the log.
            wait_for_pipeline(address, wait)
            origin = Origin(_header(address), address, options, attached=True)
            check_zones(options.zone, origin.header.size)
            outputs = stack.enter_context(replace(files, origin=origin).continued(address.endpoint, resume=False))
            status = stack.enter_context(Console(stderr=True).status("waiting for a track"))
            # Step 3: write each new track.
            for track in with_silence_warnings(tracks, outputs.idle):
                run = run or tracks.run
                if tracks.run != run and not address.stream:  # a stream of a fleet may move
                    reason = ": the run had no end, and another one started"
                    break
                # Skip frames that a restarted detector repeats, even if their track was missed: order matters.
                if track.frame < max(newest.values(), default=-1) or track.frame == newest.get(track.object):
                    continue
                with INTERRUPTS.deferred():  # a track is written everywhere or nowhere
                    outputs.write(TrackedFrame([track]))
                    not_written, newest[track.object] = outputs.not_written, track.frame
                    received += 1
                status.update(f"frame {track.frame}, {tracks.missed} missed")
        if tracks.end is not None:
            reason = f": {tracks.end.reason}"
        of = f" of {listed(newest)}" if any(newest) else ""
        lacking = f", {not_written} not written" if not_written else ""
        click.echo(f"{counted(received - not_written, 'track')}{of}, {tracks.losses()}{lacking}{reason}", err=True)
