"""What the tests of the pipeline share: a short video, and how to wait for processes."""

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

FRAMES = 32
SERVICES = Path(__file__).parents[2] / "services"


def share_found(tracks, boxes):
    """The share of the tracks whose box is that of the object."""
    found = [track.box is not None and track.box.overlap(box) > 0.5 for track, box in zip(tracks, boxes, strict=True)]
    return np.mean(found)


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
