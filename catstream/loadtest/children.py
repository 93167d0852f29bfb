"""Processes of a load test beside the pipelines: the camera, and those who read."""

from __future__ import annotations

import multiprocessing
import signal
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess

__all__ = ["SPAWN", "start"]

#: How they begin: anew, with nothing of this process but what they are handed.
SPAWN = multiprocessing.get_context("spawn")


def start(process: BaseProcess) -> None:
    """Start a process that Ctrl-C does not reach: it is for this one, which then ends them in order."""
    resource_tracker.ensure_running()  # by itself it starts with the first process, and unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a child inherits what is blocked
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
