"""What the tests of the command line share."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import ExitStack

import pytest

from catstream.video.demo import write


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    """A short demo video, and the box in its first frame as `--box` takes it."""
    path, boxes = write(tmp_path_factory.mktemp("video"), 60, (320, 240))
    return str(path), ",".join(map(str, boxes[0]))


@pytest.fixture
def catstream():
    """Starts the command `catstream`; what still runs after the test is killed."""
    # In the background a shell has Ctrl-C ignored, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with ExitStack() as stack:

        def start(*arguments, **options):
            process = subprocess.Popen(
                [sys.executable, "-c", "from catstream.cli import main; main()", *map(str, arguments)],
                **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options},
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


@pytest.fixture
def said(catstream):
    """Runs the command to its end: exit code, output, errors."""

    def run(*arguments, **options):
        process = catstream(*arguments, **options)
        output, errors = process.communicate(timeout=120)
        return process.returncode, output, errors

    return run
