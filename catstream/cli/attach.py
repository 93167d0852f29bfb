"""Options that select a running pipeline, and the wait until it answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import click
from rich.console import Console

from catstream.subscription import wait_until_running
from catstream.wire.endpoint import Endpoint

__all__ = ["wait_for_pipeline", "with_endpoint", "with_wait"]

_Command = TypeVar("_Command", bound=Callable[..., object])

_ENDPOINT = click.option(
    "--endpoint", default="", metavar="PLACE", help="Endpoint of the pipeline; not needed if only one runs."
)
_KEYS = click.option("--keys", default="", metavar="DIR", help="Folder of keys, if the pipeline requires keys.")

with_wait = click.option(
    "--wait", default=30.0, metavar="SECONDS", help="How long to wait for a pipeline that has not started."
)


def with_endpoint(command: _Command) -> _Command:
    """Add `--endpoint` and `--keys`, which select a running pipeline; the command gets both as texts."""
    return _ENDPOINT(_KEYS(command))


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
