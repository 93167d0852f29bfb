"""What the tests of the pipeline share: a short video, and how to wait for processes."""

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

FRAMES = 32
SERVICES = Path(__file__).parents[2] / "services"


@pytest.fixture(scope="session")
def video(demo_video):
    """A short demo video, and the object's box in each of its frames."""
    path, boxes = demo_video(FRAMES)
    return str(path), boxes


@pytest.fixture(scope="session")
def long_video(demo_video):
    """The same with more frames, for events that take longer."""
    path, boxes = demo_video(60)
    return str(path), boxes


@pytest.fixture
def service():
    """Starts `python services/NAME.py ...`; what still runs after the test is killed."""
    with ExitStack() as stack:

        def start(name, *arguments):
            words = [sys.executable, "-P", SERVICES / f"{name}.py", *map(str, arguments)]
            process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start
