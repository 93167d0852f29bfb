"""Recorded sequences: the initial box is in the frame, and the object is tracked.

They are next to the project in ../shared/data, or in the folder TRACKING_DATA.
"""

import os
from pathlib import Path

import pytest

from catstream.base.settings import Settings
from catstream.measure.datasets import find_sequences
from catstream.measure.onepass import evaluate

DATA = Path(os.environ.get("TRACKING_DATA") or Path(__file__).parents[3] / "shared" / "data")

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no sequences at {DATA}: set TRACKING_DATA to their folder")


def test_initial_box_of_every_sequence_is_in_its_first_frame():
    for sequence in find_sequences(DATA):
        height, width = next(sequence.frames()).shape[:2]
        x, y, w, h = sequence.boxes[0]
        assert 0 <= x + w / 2 < width, sequence.name
        assert 0 <= y + h / 2 < height, sequence.name


@pytest.mark.parametrize(
    ("name", "success", "noticed"),
    [
        ("TLD_01_david", 0.9, 0.0),
        ("TLD_02_jumping", 0.9, 0.0),
        ("TLD_04_pedestrian2", 0.95, 0.5),
        ("TLD_06_car", 0.95, 0.2),  # it is hidden three times for a short time, and mostly tracked on
        ("OTB_Crossing", 0.9, 0.0),
    ],
)
def test_object_is_tracked_and_its_absence_is_noticed(name, success, noticed):
    if not (DATA / name).is_dir():
        pytest.skip(f"{name} is not in {DATA}")
    (run,) = evaluate(find_sequences(DATA / name), Settings())
    score = run.score()
    assert len(run.boxes) == len(run.sequence)
    assert score.success >= success
    if noticed:
        assert score.noticed >= noticed * score.absent
