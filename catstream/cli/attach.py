"""Options that select a running pipeline, and the wait until it answers."""

from __future__ import annotations

import click
from rich.console import Console

from catstream.client.registry import address_of
from catstream.client.subscription import wait_until_running
from catstream.services.options import NumberRange, combined, with_keys
from catstream.wire.endpoint import Endpoint


def _endpoint(endpoint: str, stream: str, fleet: str) -> str:
    if endpoint and (stream or fleet):
        raise click.UsageError("--endpoint selects a pipeline, --stream and --fleet a stream of a fleet: give one")
    if fleet and not stream:
        raise click.UsageError("--fleet selects a fleet: give the name of its stream, too (--stream NAME)")
    return address_of(fleet, stream) if stream else endpoint


with_fleet_address = click.option(
    "--fleet", default="", metavar="ADDRESS", help="HOST:PORT or name of the fleet; not needed if only one runs here."
)

#: Adds the options that select a running pipeline, as two texts: the arguments `endpoint` and `keys`. The endpoint of a
#: stream of a fleet is its address, `fleet://FLEET/STREAM`.
with_endpoint = combined(
    "endpoint",
    _endpoint,
    click.option(
        "--endpoint", default="", metavar="PLACE", help="Endpoint of the pipeline; not needed if only one runs."
    ),
    click.option("--stream", default="", metavar="NAME", help="A stream of a fleet, instead of --endpoint."),
    with_fleet_address,
    with_keys,
)

with_wait = click.option(
    "--wait",
    type=NumberRange(0),
    default=30.0,
    show_default=True,
    metavar="SECONDS",
    help="Longest wait for the pipeline at --endpoint.",
)


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
