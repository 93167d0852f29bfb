"""Waiting for the pipeline that a verb attaches to."""

from __future__ import annotations

from rich.console import Console

from catstream.subscription import knock
from catstream.wire.endpoint import Endpoint

__all__ = ["wait_for_pipeline"]


def wait_for_pipeline(endpoint: str, keys: str, seconds: float) -> Endpoint:
    """Wait until a process of the pipeline answers, and return its endpoint; a terminal shows that it waits.

    Raises
    ------
    ServiceError
        If `endpoint` is empty and not just one pipeline runs, or the pipeline does not let these keys in.
    SilenceError
        If no process answers in time.
    """
    with Console(stderr=True).status(f"waiting for a pipeline {endpoint and f'at {endpoint}'}"):
        return knock(endpoint, keys, seconds)
