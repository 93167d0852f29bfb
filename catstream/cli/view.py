"""`catstream view`: the web page of a running pipeline."""

from __future__ import annotations

import signal

import click

__all__ = ["view"]


@click.command()
@click.option("--endpoint", default="", metavar="PLACE", help="Where the pipeline runs; the only one where not given.")
@click.option("--keys", default="", metavar="DIR", help="Folder of the keys that it lets in, where it asks for some.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Where to listen.")
@click.option("--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="0 for any that is free.")
@click.option("--token", envvar="VIEW_TOKEN", show_envvar=True, help="What to show to get in; 16 characters or more.")
def view(endpoint: str, keys: str, host: str, port: int, token: str | None) -> None:
    """Look at a running pipeline in a browser, and steer it.

    The page shows the picture with the box, the score, frames a second, the
    coreset trees as they grow, and the frames that taught most. A box drawn
    on the picture is followed from there on. It waits where no pipeline runs,
    and goes on with the next one. Ctrl-C ends it; the pipeline goes on.

    On another host than 127.0.0.1 a token is needed. What travels is not
    encrypted: through an ssh tunnel, or behind a proxy with TLS, it is.

    \b
    Serves
      /          the page
      /metrics   for Prometheus: catstream_frames_total ...
      /healthz   200 while this server runs
      /readyz    200 while all processes of the pipeline are heard

    \b
    EXAMPLES
      catstream view
      catstream view --endpoint run --port 8080
      VIEW_TOKEN=$(openssl rand -hex 16) catstream view --host 0.0.0.0
    """
    from catstream.web.server import Server

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    server = Server(endpoint, keys, host=host, port=port, token=token)
    click.echo(server.url)
    server.run()
