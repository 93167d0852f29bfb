"""`catstream fleet`: run many streams on one machine or on many, and change them while they run."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from catstream.base.names import split_name
from catstream.cli.attach import with_fleet_address
from catstream.cli.common import screen, table
from catstream.cli.options import PATH, with_json
from catstream.cli.view import HostPort, fleet_view, server_of, with_view
from catstream.client.address import Address
from catstream.errors import FleetError
from catstream.wire.messages import FleetStatus

if TYPE_CHECKING:
    from catstream.fleet.fleet import Fleet

UP_SECONDS = 120.0  # timeout of `up` for the start of the streams
_SHOW_SECONDS = 0.5  # interval of updates of the status
_STARTED = ("running", "lost", "waiting", "paused", "ended", "failed")


@click.group()
def fleet() -> None:
    """Run many streams on one machine or on many, and change them while they run.

    A fleet keeps each stream running on some node, and continues it elsewhere
    from its last state if the node dies. Clients find a stream by its name. Ray
    places and watches the processes: pip install ".[fleet]".

    \b
    EXAMPLES
      catstream fleet up examples/fleet.toml
      catstream fleet up fleet.toml --address 10.0.0.1:6379   # after `ray start`
      catstream fleet status
      catstream watch tracks --endpoint fleet://cam-1
      catstream fleet down
    """


def with_fleet(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that select a fleet by its controller; the command receives the connected fleet first."""

    @click.option(
        "--name", "fleet_name", default="", metavar="NAME", help="Name of the fleet; not needed if only one runs here."
    )
    @click.option(
        "--address",
        default="",
        metavar="HOST:PORT",
        help="Head of a cluster of Ray, of which this machine is a node; default: RAY_ADDRESS, or this machine alone.",
    )
    @wraps(command)
    def wrapped(fleet_name: str, address: str, file: Path | None = None, **options: object) -> None:
        from catstream.fleet.fleet import Fleet

        with Fleet(file, name=fleet_name, address=address) as running:
            command(running, **options)

    return wrapped


@fleet.command(short_help="Start the streams of a file, or apply its changes.")
@click.argument("file", type=PATH)
@with_view
@with_fleet
def up(running: Fleet, view: HostPort | None) -> None:
    """Start the streams of FILE, or apply its changes to a fleet that runs.

    On a cluster of Ray (--address), or if the fleet runs already, the command
    returns once the streams run. Otherwise it starts Ray on this machine, and
    ends it and the streams on Ctrl-C. The next `up` continues from the last
    states. A stream that runs and is unchanged is not touched. The name of the
    fleet is the one in FILE, or the name of FILE; --name replaces it.

    \b
    EXAMPLES
      catstream fleet up examples/fleet.toml --view
      catstream fleet up fleet.toml --address 10.0.0.1:6379
    """
    from catstream.web.wall import Wall

    server = None if view is None else server_of(Wall(Address(fleet=running.name)), view)  # it listens already
    with Console(stderr=True).status("starting the fleet"):
        lines = running.up()
    for line in lines:
        click.echo(line)
    with ExitStack() as stack, suppress(KeyboardInterrupt):
        if server is not None:
            if not running.is_owner:
                raise click.UsageError("--view needs a fleet that ends with this command: use catstream fleet view")
            stack.enter_context(server.in_background())
            for url in server.urls:
                click.echo(f"page: {url}")
        _watch(screen(), running)
    if running.is_owner and running.is_running:
        _down(running)


def _down(fleet: Fleet) -> None:
    with Console(stderr=True).status("storing the states of all streams"):
        unstored = fleet.down()
    for line in unstored:
        click.echo(line, err=True)
    click.echo(f"the fleet {fleet.name} is down")
    if unstored:
        sys.exit(1)


def _watch(console: Console, fleet: Fleet) -> None:
    """Show the streams until all have started, or, if this program has started the fleet, until the fleet ends."""
    deadline = time.monotonic() + UP_SECONDS
    status = fleet.status()
    try:
        with Live(console=console, transient=True) as live:
            while fleet.is_owner or (
                time.monotonic() < deadline
                and not all(stream.state in _STARTED or stream.trouble for stream in status.streams.values())
            ):
                live.update(Group(*_tables(status)))
                time.sleep(_SHOW_SECONDS)
                status = fleet.status()
    except FleetError:
        if not fleet.is_owner or fleet.is_running:
            raise
        click.echo(f"the fleet {fleet.name} was ended from elsewhere")
    finally:
        console.print(*_tables(status), sep="\n")


@fleet.command()
@with_fleet_address
@with_json
def status(address: Address, as_json: bool) -> None:
    """Show all streams and nodes of a fleet.

    The exit status is 1 if a stream has a problem, which is printed below the
    table, for example that its source cannot be opened.

    \b
    EXAMPLES
      catstream fleet status
      catstream fleet status --fleet 10.0.0.1:5690 --keys my-keys --json | jq .streams
    """
    with address.registry as registry:
        fleet = registry.streams()
    if as_json:
        click.echo(json.dumps(dataclasses.asdict(fleet)))
    else:
        screen().print(*_tables(fleet), sep="\n")
    if any(stream.trouble for stream in fleet.streams.values()):
        sys.exit(1)


fleet.add_command(fleet_view)


@fleet.command(short_help="Add a stream, or change the one of that name.")
@click.argument("name")
@click.argument("source")
@click.option("--box", "boxes", multiple=True, metavar="[NAME=]X,Y,W,H", help="Box of an object in the first frame.")
@click.option("--model", "models", multiple=True, metavar="[NAME=]FILE", help="Saved model of an object to search for.")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="A setting.")
@click.option("--write", multiple=True, metavar="DEST", help="Destination of its tracks, as in the file.")
@with_fleet
def add(
    running: Fleet,
    name: str,
    source: str,
    boxes: tuple[str, ...],
    models: tuple[str, ...],
    settings: tuple[str, ...],
    write: tuple[str, ...],
) -> None:
    """Add a stream, or change the one of that name.

    The file of the fleet is not changed, and its defaults do not apply. All
    other keys of a stream, such as cores and labels, need the file and `up`.

    \b
    EXAMPLE
      catstream fleet add gate rtsp://10.0.0.1/1 --box 120,80,64,48 --write "tracks/{stream}.ndjson"
    """
    from catstream.fleet.spec import StreamSpec

    table = {
        "source": source,
        "boxes": dict(map(split_name, boxes)),
        "models": dict(map(split_name, models)),
        "settings": dict(setting.partition("=")[::2] for setting in settings),
        "write": list(write),
    }
    for line in running.add(StreamSpec.parse(name, table, Path.cwd())):
        click.echo(line)


@fleet.command()
@click.argument("names", nargs=-1, required=True)
@click.option("--forget", is_flag=True, help="Also remove their models.")
@with_fleet
def remove(running: Fleet, names: tuple[str, ...], forget: bool) -> None:
    """Remove streams; their models stay in the store."""
    for line in running.remove(*names, forget=forget):
        click.echo(line)


@fleet.command()
@with_fleet
def down(running: Fleet) -> None:
    """Store the state of all streams, stop them, and end the fleet.

    On this machine, Ray ends with the fleet. On a cluster, Ray stays.
    `catstream fleet up` continues from the last states. The exit status is 1 if
    the last state of a stream could not be stored.
    """
    _down(running)


def _tables(status: FleetStatus) -> list[RenderableType]:
    """The streams, a line for each problem, and the nodes."""
    troubles = [Text(f"{stream.name}: {stream.trouble}") for stream in status.streams.values() if stream.trouble]
    return [_streams(status), *([Text(), *troubles] if troubles else []), _nodes(status)]


def _streams(status: FleetStatus) -> Table:
    """A row for each stream, streams with trouble first."""
    numbers = ("frame", "skipped", "model", "present")
    rows = table("stream", "node", "state", *numbers, right=numbers)
    for stream in sorted(status.streams.values(), key=lambda stream: (not stream.trouble, stream.name)):
        figures = (stream.frame, stream.skipped, max(stream.models.values(), default=0))
        present = f"{sum(stream.present.values())} of {len(stream.present)}" if stream.present else "-"
        texts = (*(str(figure or "-") for figure in figures), present)
        rows.add_row(stream.name, stream.node or "-", stream.state, *texts)
    return rows


def _nodes(status: FleetStatus) -> Table:
    numbers = ("\nstreams", "\ncores")
    rows = table("\nnode", "\nstate", "\naddress", *numbers, "\nlabels", right=numbers)
    for node in status.nodes.values():
        labels = ", ".join(f"{key}={value}" for key, value in node.labels.items())
        cores = f"{node.used:.3g} of {node.cores:.3g}"
        rows.add_row(node.name, node.state, node.address, str(node.streams), cores, labels)
    return rows
