"""`catstream fleet view`: serve a web page for all streams of a fleet."""

from __future__ import annotations

import signal

import click

from catstream.cli.serving import PORT, Address, AddressType, with_token

__all__ = ["view"]


@click.command()
@click.option(
    "--fleet",
    default="",
    metavar="ADDRESS",
    help="HOST:PORT of the fleet, or the name of one of yours; not needed if only one runs.",
)
@click.option("--keys", default="", metavar="DIR", help="Folder of keys, if the fleet requires keys.")
@click.option(
    "--listen",
    default=f"127.0.0.1:{PORT}",
    show_default=True,
    type=AddressType(),
    help="Address to listen on; port 0 for any free port.",
)
@with_token()
def view(fleet: str, keys: str, listen: Address, token: str | None) -> None:
    """Watch all streams of a fleet in a browser.

    The page shows the state and a small picture of each stream, those in
    trouble first, and the nodes. Each stream links to its own page, which is
    that of catstream view. If the fleet does not answer, the page keeps its
    last state and waits. Ctrl-C ends the server; the fleet continues.

    Only users with the token can watch and steer: open the printed link, which
    ends with it. Each start makes a new token; give one of your own to keep
    it, for example for Prometheus. The connection is not encrypted: from
    other machines, use an ssh tunnel, or a proxy with TLS.

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
    from catstream.web.fleet_app import fleet_site
    from catstream.web.server import Server

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    server = Server(fleet_site(fleet, keys), host=listen.host, port=listen.port, token=token)
    for url in server.urls:
        click.echo(url)
    server.run()
