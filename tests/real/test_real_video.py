"""Real files: every frame is read, and the truth fits it."""

import numpy as np
import pytest

from catstream.applications.evaluation.datasets import find_sequences
from catstream.errors import VideoError
from catstream.video.source import open_source

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
