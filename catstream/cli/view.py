"""`catstream view` and `catstream fleet view`: serve a web page of a running pipeline, or of all streams of a fleet."""

from __future__ import annotations

import os
import secrets
from typing import TYPE_CHECKING, NamedTuple

import click

from catstream.base.files import state_home, write_atomically
from catstream.cli.attach import with_address, with_fleet_address
from catstream.client.address import Address
from catstream.errors import ServiceError

if TYPE_CHECKING:
    from catstream.web.annotator import AnnotationSite
    from catstream.web.app import Site
    from catstream.web.server import Server
    from catstream.web.wall import Wall

#: Default port of the page.
PORT = 8000

_LARGEST_PORT = 65535
_ATTEMPTS = 100  # ports of PORT+


class HostPort(NamedTuple):
    """The address on which the web server listens; if its port is in use, it tries up to `attempts` ports."""

    host: str
    port: int
    attempts: int = 1


class HostPortType(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.2 only
    """Parameter type [HOST:]PORT; the default host is 127.0.0.1. PORT+ is that port or the next free one.

    >>> [tuple(HostPortType().convert(text, None, None)) for text in ("8080", "[::]:0", "0.0.0.0:8000+")]
    [('127.0.0.1', 8080, 1), ('::', 0, 1), ('0.0.0.0', 8000, 100)]
    """

    name = "[HOST:]PORT"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> HostPort:
        text = str(value).removesuffix("+")
        attempts = 1 if text == str(value) else _ATTEMPTS
        host, _, port = text.rpartition(":")
        is_port = port.isascii() and port.isdigit() and int(port) <= _LARGEST_PORT
        if not is_port or host.startswith("[") != host.endswith("]"):
            self.fail(f"expected [HOST:]PORT, for example 8000 or 0.0.0.0:8000, got {value!r}", param, ctx)
        return HostPort(host.removeprefix("[").removesuffix("]") or "127.0.0.1", int(port), attempts)


#: Replaces a token: every user of this machine may use the page.
_OPEN = "none"


def _token_of_user() -> str:
    """The stored token of this user, so that links stay valid; a new one each time if it cannot be stored."""
    token = secrets.token_hex(16)
    try:
        file = state_home() / "view-token"
        is_own = file.exists() and (not hasattr(os, "geteuid") or file.stat().st_uid == os.geteuid())
        if is_own and not file.stat().st_mode & 0o077:
            return file.read_text(encoding="ascii").strip()
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomically(file, f"{token}\n".encode(), mode=0o600)
    except (OSError, ServiceError, ValueError):  # no home directory, no permission, or a file with other content
        pass
    return token


def token_of_page() -> str | None:
    """Return the variable VIEW_TOKEN, or else the token of the user; None for "none"."""
    token = os.environ.get("VIEW_TOKEN") or _token_of_user()
    return None if token == _OPEN else token


def server_of(site: Site | Wall | AnnotationSite, listen: HostPort) -> Server:
    from catstream.web.server import Server

    return Server(site, host=listen.host, port=listen.port, attempts=listen.attempts, token=token_of_page())


#: Adds `--view`, which serves a page during a command.
with_view = click.option(
    "--view",
    type=HostPortType(),
    is_flag=False,
    flag_value=f"{PORT}+",
    metavar="[[HOST:]PORT]",
    help=f"Serve a web page; default: port {PORT} or the next.",
)

#: Adds `--listen`.
with_listen = click.option(
    "--listen",
    default=f"127.0.0.1:{PORT}",
    show_default=True,
    type=HostPortType(),
    help="Address to listen on; port 0 for any free port.",
)


@click.command()
@with_address
@with_listen
def view(address: Address, listen: HostPort) -> None:
    """Watch and control a running pipeline in a browser.

    The page shows the picture with the box of each object, the score, frames
    per second, and the coreset trees. If you draw a box on the picture, the
    pipeline tracks that object. If no pipeline runs, the page waits for the
    next one. Ctrl-C ends the server; the pipeline continues.

    Only users with the token can watch and control: open the printed link,
    which ends with it. The variable VIEW_TOKEN sets another one of at least 16
    characters; "none" lets every user of this machine watch and control. The
    connection is not encrypted: from other machines, use an ssh tunnel, or a
    proxy with TLS.

    \b
    EXAMPLES
      catstream view
      catstream view --endpoint run --listen 8080
      VIEW_TOKEN=$(cat my-token) catstream view --listen 0.0.0.0:8000
    """
    from catstream.web.app import Site
    from catstream.web.feed import PipelineFeed

    if address.endpoint:
        address.resolve()  # raises errors that waiting does not solve
    _serve(Site(PipelineFeed(address)), listen)


@click.command("view")
@with_fleet_address
@with_listen
def fleet_view(address: Address, listen: HostPort) -> None:
    """Watch all streams of a fleet in a browser.

    The page is a wall of pictures, those in trouble first, and a table of the
    nodes. Each stream links to the page of its own run.
    If the fleet does not answer, the page keeps its last state and waits.
    Ctrl-C ends the server; the fleet continues. Token and encryption are as
    for catstream view.

    \b
    EXAMPLES
      catstream fleet view
      catstream fleet view --fleet head.example.org:5690 --keys my-keys
    """
    from catstream.web.wall import Wall

    _serve(Wall(address), listen)


def _serve(site: Site | Wall, listen: HostPort) -> None:
    """Print the links of a site, and serve it until Ctrl-C or SIGTERM."""
    server = server_of(site, listen)
    for url in server.urls:
        click.echo(url)
    server.run()
