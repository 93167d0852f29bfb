"""`catstream merge`, as a person uses it."""

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


def test_a_merge_that_cannot_be_made_is_one_line_and_writes_nothing(fail, succeed, models, tmp_path):
    door, yard, _ = models
    damaged, kept = tmp_path / "damaged", tmp_path / "kept"
    damaged.write_bytes(door.read_bytes()[:-9])
    kept.write_text("kept")
    for words, why in (
        ((door, door, "-o", tmp_path / "new"), "the same frames"),
        ((door, "-o", tmp_path / "new"), "needs two or more"),
        ((door, damaged, "-o", tmp_path / "new"), "not an undamaged file"),
        ((door, tmp_path / "none", "-o", tmp_path / "new"), "there is no saved model"),
        ((door, yard, "-o", kept), "exists already"),
    ):
        assert why in fail("merge", *words)
    assert not (tmp_path / "new").exists()
    assert kept.read_text() == "kept"
    succeed("merge", door, yard, "-o", kept, "--overwrite")


def test_models_of_different_objects_are_merged_only_with_force(fail, succeed, models, tmp_path):
    door, _, lake = models
    error = fail("merge", door, lake, "-o", tmp_path / "both")
    assert "saved models 1 and 2 look like different objects" in error
    assert "--force" in error
    output, errors = succeed("merge", door, lake, "-o", tmp_path / "both", "--force")
    assert (errors, "2 saved models" in output) == ("", True)
