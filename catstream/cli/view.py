"""`catstream view`: serve a web page for a running pipeline."""

from __future__ import annotations

import signal

import click

from catstream.cli.attach import with_endpoint
from catstream.cli.serving import PORT, with_token

__all__ = ["view"]


@click.command()
@with_endpoint
@click.option("--host", default="127.0.0.1", show_default=True, help="Host name or address to listen on.")
@click.option(
    "--port",
    default=PORT,
    show_default=True,
    type=click.IntRange(0, 65535),
    help="Port to listen on; 0 for any free port.",
)
@with_token()
def view(endpoint: str, keys: str, host: str, port: int, token: str | None) -> None:
    """Watch and steer a running pipeline in a browser.

    The page shows the picture with the box of each object, the score, frames
    per second, the coreset trees, and the most surprising frames. If you draw
    a box on the picture, the pipeline tracks that object. If no pipeline runs,
    the page waits for the next one. Ctrl-C ends the server; the pipeline
    continues.

    Only users with the token can watch and steer: open the printed link, which
    ends with it. Each start makes a new token; give one of your own to keep
    it, for example for Prometheus. The connection is not encrypted: from
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
      catstream view --endpoint run --port 8080
      catstream view --host 0.0.0.0
      VIEW_TOKEN_FILE=my-token catstream view
    """
    from catstream.web.app import pipeline_site
    from catstream.web.server import Server

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    server = Server(pipeline_site(endpoint, keys), host=host, port=port, token=token)
    for url in server.urls:
        click.echo(url)
    server.run()
