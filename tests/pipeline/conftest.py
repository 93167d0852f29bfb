"""What the tests of the pipeline share: a short video, and how to wait for processes."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack

import psutil
import pytest

FRAMES = 60


@pytest.fixture(scope="session")
def video(demo_video):
    """A short demo video, and the object's box in each of its frames."""
    path, boxes = demo_video(FRAMES)
    return str(path), boxes


@pytest.fixture
def alive():
    """Whether a process runs; one that ended and was not asked for its exit code yet does not."""

    def runs(pid):
        try:
            return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            return False

    return runs


@pytest.fixture
def service():
    """Starts `python -P -m catstream.services ...`; what still runs after the test is killed."""
    with ExitStack() as stack:

        def start(*arguments):
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "catstream.services", *map(str, arguments)],
                stderr=subprocess.PIPE,
                text=True,
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start
