"""Starts the processes of a load test beside the pipelines: the camera and the subscribers."""

from __future__ import annotations

import signal
from multiprocessing.process import BaseProcess

from catstream.services.start import SPAWN

__all__ = ["SPAWN", "start"]


def start(process: BaseProcess) -> None:
    """Start a process in which SIGINT is blocked: on Ctrl-C, the parent ends its children in order."""
    SPAWN.get_context()  # starts the resource tracker now, because its start unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a child inherits the signal mask
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
