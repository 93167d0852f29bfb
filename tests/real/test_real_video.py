"""Real files: every frame is read, the truth fits it, and the object is followed.

They are beside the project in ../shared/data, or where TRACKING_DATA says.
"""

import os
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.detection.scm import SparseCollaborativeModel
from catstream.errors import VideoError
from catstream.measure.datasets import Sequence, find_sequences
from catstream.measure.onepass import evaluate
from catstream.video.source import open_source

DATA = Path(os.environ.get("TRACKING_DATA") or Path(__file__).parents[3] / "shared" / "data")


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of all sequences; the test is skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no real sequences at {DATA}: put some there, or set TRACKING_DATA")
    return DATA


@pytest.fixture(scope="session")
def real(data: Path) -> Callable[[str], Sequence]:
    """A real sequence by its name; the test is skipped where it is absent."""

    def find(name: str) -> Sequence:
        if not (data / name).is_dir():
            pytest.skip(f"{name} is not in {data}")
        return find_sequences(data / name)[0]

    return find


VIDEOS = ["TLD_01_david", "TLD_02_jumping", "TLD_04_pedestrian2", "TLD_06_car", "TLD_10_panda"]


@pytest.mark.parametrize("name", VIDEOS)
def test_a_video_gives_as_many_frames_as_its_truth_has_boxes(real, name):
    sequence = real(name)
    with open_source(sequence.path) as source:
        numbers = [frame.number for frame in source]
    assert numbers == list(range(len(sequence)))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_truncated_video_gives_the_frames_before_the_break(real, tmp_path, share):
    sequence = real("TLD_06_car")
    whole = (sequence.path / "car.mpg").read_bytes()
    (tmp_path / "car.mpg").write_bytes(whole[: int(len(whole) * share)])
    images, count = sequence.frames(), 0

    def read() -> None:
        nonlocal count
        with open_source(tmp_path / "car.mpg") as source:
            for frame in source:
                np.testing.assert_array_equal(frame.image, next(images))
                count += 1

    with pytest.raises(VideoError, match="is damaged at frame"):
        read()
    assert 0.6 * share < count / len(sequence) < 1.4 * share


def test_every_sequence_is_found_and_starts_inside_its_first_frame(data):
    for sequence in find_sequences(data):
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
def test_the_object_is_followed(real, name, success, noticed):
    sequence = real(name)
    (run,) = evaluate([sequence], Settings())
    score = run.score()
    assert score.success >= success
    if noticed:
        assert score.noticed >= noticed * score.absent


def test_the_first_frames_are_followed(real):
    sequence = real("OTB_Crossing")
    frames, truth = islice(sequence.frames(), 50), [Box(*box) for box in sequence.boxes[:50]]
    model = SparseCollaborativeModel(next(frames), truth[0], np.random.default_rng(0), particles=40)
    overlaps = [model.track(frame)[1].overlap(box) for frame, box in zip(frames, truth[1:], strict=True)]
    assert np.mean(np.array(overlaps) > 0.5) >= 0.9
