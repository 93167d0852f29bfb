"""`catstream view`: the web page of a running pipeline."""

from __future__ import annotations

import signal

import click

from catstream.cli.attach import with_endpoint
from catstream.cli.serving import PORT, with_token

__all__ = ["view"]


@click.command()
@with_endpoint
@click.option("--host", default="127.0.0.1", show_default=True, help="Where to listen.")
@click.option("--port", default=PORT, show_default=True, type=click.IntRange(0, 65535), help="0 for any that is free.")
@with_token()
def view(endpoint: str, keys: str, host: str, port: int, token: str | None) -> None:
    """Look at a running pipeline in a browser, and steer it.

    The page shows the picture with the box, the score, frames a second, the
    coreset trees as they grow, and the frames that taught most. A box drawn
    on the picture is followed from there on. If no pipeline runs, the page
    waits for one, and it goes on with the next one. Ctrl-C ends it; the
    pipeline goes on.

    On another host than 127.0.0.1 a token is needed; the addresses that are
    printed end with it. What travels is not encrypted: through an ssh tunnel,
    or behind a proxy with TLS, it is.

    \b
    Serves
      /              the page
      /live.mjpeg    the newest picture with its track drawn in, again and again
      /metrics       for Prometheus: catstream_frames_total ...
      /healthz       200 while this server runs
      /readyz        200 while all processes of the pipeline are heard

    \b
    EXAMPLES
      catstream view
      catstream view --endpoint run --port 8080
      VIEW_TOKEN=$(openssl rand -hex 16) catstream view --host 0.0.0.0
    """
    from catstream.web.server import Server

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    server = Server(endpoint, keys, host=host, port=port, token=token)
    for url in server.urls:
        click.echo(url)
    server.run()
