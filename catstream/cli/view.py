"""`catstream view` and `catstream fleet view`: serve a web page of a running pipeline, or of all streams of a fleet."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from catstream.cli.attach import with_endpoint, with_fleet_address
from catstream.cli.serving import PORT, Address, AddressType, with_token
from catstream.services.options import with_keys

if TYPE_CHECKING:
    from catstream.web.app import Site

_with_listen = click.option(
    "--listen",
    default=f"127.0.0.1:{PORT}",
    show_default=True,
    type=AddressType(),
    help="Address to listen on; port 0 for any free port.",
)


@click.command()
@with_endpoint
@_with_listen
@with_token()
def view(endpoint: str, keys: str, listen: Address, token: str | None) -> None:
    """Watch and control a running pipeline in a browser.

    The page shows the picture with the box of each object, the score, frames
    per second, the coreset trees, and the most surprising frames. If you draw
    a box on the picture, the pipeline tracks that object. If no pipeline runs,
    the page waits for the next one. Ctrl-C ends the server; the pipeline
    continues.

    Only users with the token can watch and control: open the printed link,
    which ends with it. Each start makes a new token; give one of your own to
    keep it, for example for Prometheus. The connection is not encrypted: from
    other machines, use an ssh tunnel, or a proxy with TLS.

    \b
    Serves
      /              the page
      /live.mjpeg    the newest pictures with their tracks drawn in, as MJPEG
      /metrics       metrics for Prometheus: catstream_frames_total ...
      /healthz       200 while this server runs
      /readyz        200 while all processes send health reports

    \b
    EXAMPLES
      catstream view
      catstream view --endpoint run --listen 8080
      catstream view --listen 0.0.0.0:8000
      VIEW_TOKEN_FILE=my-token catstream view
    """
    from catstream.web.app import pipeline_site

    _serve(pipeline_site(endpoint, keys), listen, token)


@click.command("view")
@with_fleet_address
@with_keys
@_with_listen
@with_token()
def fleet_view(fleet: str, keys: str, listen: Address, token: str | None) -> None:
    """Watch all streams of a fleet in a browser.

    The page shows the state and a small picture of each stream, those in
    trouble first, and the nodes. Each stream links to its own page, which is
    that of catstream view. If the fleet does not answer, the page keeps its
    last state and waits. Ctrl-C ends the server; the fleet continues. Token
    and encryption are as for catstream view.

    \b
    Serves
      /                 the page of the fleet
      /streams/NAME/    the page of a stream
      /metrics          metrics of all streams and nodes for Prometheus
      /healthz          200 while this server runs
      /readyz           200 while the fleet answers

    \b
    EXAMPLES
      catstream fleet view
      catstream fleet view --fleet head.example.org:5690 --keys my-keys
      catstream fleet view --listen 0.0.0.0:8000
      VIEW_TOKEN_FILE=my-token catstream fleet view
    """
    from catstream.web.app import fleet_site

    _serve(fleet_site(fleet, keys), listen, token)


def _serve(site: Site, address: Address, token: str | None) -> None:
    """Print the links of a site, and serve it until Ctrl-C or SIGTERM."""
    from catstream.web.server import Server

    server = Server(site, host=address.host, port=address.port, token=token)
    for url in server.urls:
        click.echo(url)
    server.run()
