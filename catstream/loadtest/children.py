"""Processes of a load test beside the pipelines: the camera, and those who read."""

from __future__ import annotations

import signal
from multiprocessing.process import BaseProcess

from catstream.services.start import SPAWN

__all__ = ["SPAWN", "start"]


def start(process: BaseProcess) -> None:
    """Start a process that Ctrl-C does not reach: it is for this one, which then ends them in order."""
    SPAWN.get_context()  # starts the resource tracker: with the first process it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a child inherits what is blocked
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
