"""`catstream merge`, as a person uses it."""

import re

import pytest

from catstream.base.box import Box
from catstream.client.saved_model import SavedModel
from tests.learning import learned_from

#: A part of the background of the demo video.
LAKE = Box(20.0, 160.0, 60.0, 60.0)


@pytest.fixture(scope="session")
def models(demo_video, once):
    """Two saved models of one object, learned from two parts of the demo video, and one of a part of the background."""
    path, boxes = demo_video(60)

    def learn(folder):
        for name, first, box in (("door", 0, boxes[0]), ("yard", 30, boxes[30]), ("lake", 0, LAKE)):
            learned_from(path, box, slice(first, first + 15), {"coreset.size": 16}).save(folder / name)

    folder = once("models", learn)
    return folder / "door", folder / "yard", folder / "lake"


def test_models_of_two_cameras_are_merged_into_one_file(succeed, models, tmp_path):
    door, yard, _ = models
    output, errors = succeed("merge", door, yard, "-o", tmp_path / "both")
    assert not errors
    one, other, both = map(SavedModel.load, (door, yard, tmp_path / "both"))
    rows = both.trees["object"].rows_seen
    assert rows == one.trees["object"].rows_seen + other.trees["object"].rows_seen
    assert f"2 saved models, 2 videos, {rows} rows of the object" in output


def test_models_of_different_objects_are_merged_only_with_force(fail, succeed, models, tmp_path):
    door, _, lake = models
    both = ["-o", tmp_path / "both"]
    assert re.search("saved models 1 and 2 look like different objects.*--force", fail("merge", door, lake, *both))
    assert "2 saved models" in succeed("merge", door, lake, *both, "--force")[0]
    assert "exists already" in fail("merge", door, lake, *both, "--force")
    succeed("merge", door, lake, *both, "--force", "--overwrite")
