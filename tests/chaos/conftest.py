"""The faults are those of `benchmarks/chaos.py`."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from catstream.settings import Settings
from catstream.tracker import Tracker
from catstream.video.demo import write
from catstream.video.source import open_source

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    """A short demo video, and the object's box in each of its frames."""
    path, boxes = write(tmp_path_factory.mktemp("video"), 90, (320, 240))
    return str(path), boxes


@pytest.fixture(scope="session")
def calm(video):
    """The tracker after the same video, in one process and undisturbed, and its tracks."""
    path, boxes = video
    tracker, tracks = Tracker(Settings(lockstep=True)), []
    with open_source(path) as source:
        for frame in source:
            if tracks:
                tracker.update(frame.image, frame.time)
            else:
                tracker.init(frame.image, boxes[0], frame.time)
            tracks.append(tracker.track)
    return tracker, tracks


@pytest.fixture
def until():
    """Wait until a condition holds, and return what it returned; fail where it does not within two minutes."""

    def wait(condition):
        deadline = time.monotonic() + 120
        while not (found := condition()):
            assert time.monotonic() < deadline, "it did not happen in time"
            time.sleep(0.01)
        return found

    return wait
