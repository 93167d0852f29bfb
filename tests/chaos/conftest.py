"""Fixtures with the faults of `benchmarks/chaos.py`."""

import sys
from pathlib import Path

import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[2] / "benchmarks")]


@pytest.fixture(scope="session")
def video(demo_video):
    """A short demo video, and the object's box in each of its frames."""
    path, boxes = demo_video(200)
    return str(path), boxes


@pytest.fixture(scope="session")
def calm(video):
    """Tracks of the same video in one process without faults, and the trees."""
    import chaos

    path, boxes = video
    return chaos.undisturbed(path, {chaos.FIRST: boxes[0]})
