"""Options that select a running pipeline, and the wait until it answers."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import click
from rich.console import Console

from catstream.client.registry import address_of
from catstream.client.subscription import wait_until_running
from catstream.wire.endpoint import Endpoint

__all__ = ["wait_for_pipeline", "with_endpoint", "with_wait"]

_OPTIONS = (
    click.option(
        "--endpoint", default="", metavar="PLACE", help="Endpoint of the pipeline; not needed if only one runs."
    ),
    click.option("--stream", default="", metavar="NAME", help="A stream of a fleet, instead of --endpoint."),
    click.option(
        "--fleet",
        default="",
        metavar="ADDRESS",
        help="HOST:PORT or name of its fleet; not needed if only one runs here.",
    ),
    click.option("--keys", default="", metavar="DIR", help="Folder of keys, if the pipeline or fleet requires keys."),
)

with_wait = click.option(
    "--wait", default=30.0, metavar="SECONDS", help="How long to wait for a pipeline that has not started."
)


def with_endpoint(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that select a running pipeline; the command gets them as two texts, `endpoint` and `keys`.

    The endpoint of a stream of a fleet is its address, `fleet://FLEET/STREAM`.
    """

    @wraps(command)
    def wrapped(*, endpoint: str, stream: str, fleet: str, **options: object) -> None:
        if endpoint and (stream or fleet):
            raise click.UsageError("--endpoint selects a pipeline, --stream and --fleet a stream of a fleet: give one")
        if fleet and not stream:
            raise click.UsageError("--fleet selects a fleet: give the name of its stream, too (--stream NAME)")
        command(endpoint=address_of(fleet, stream) if stream else endpoint, **options)

    for option in reversed(_OPTIONS):
        wrapped = option(wrapped)
    return wrapped


def wait_for_pipeline(endpoint: str, keys: str, seconds: float) -> Endpoint:
    """Wait until a process of the pipeline answers, and return its endpoint; a terminal shows a status line.

    Raises
    ------
    ServiceError
        If `endpoint` is empty and not exactly one pipeline runs, or the pipeline rejects the keys.
    SilenceError
        If no process answers in time.
    """
    with Console(stderr=True).status(f"waiting for a pipeline {endpoint and f'at {endpoint}'}"):
        return wait_until_running(endpoint, keys, seconds)
