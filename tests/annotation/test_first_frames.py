"""Boxes in the first frames of videos: which are shown, and that no other box of a table is lost."""

import pytest

from catstream.annotation.first_frames import FirstFrames
from catstream.base.box import Box
from catstream.base.settings import Settings

BOX = Box(20.0, 30.0, 40.0, 50.0)


@pytest.fixture
def frames(demo_video, tmp_path):
    (tmp_path / "cam.mp4").write_bytes(demo_video(3)[0].read_bytes())
    (tmp_path / "broken.mp4").write_bytes(b"none")
    boxes = {"broken.mp4": [("ben", 0, BOX)], "cam.mp4": [("anna", 0, BOX), ("anna", 2, BOX), ("ben", 0, None)]}
    with FirstFrames(tmp_path, boxes, Settings(), lambda *_: None) as one:
        yield one


def test_boxes_in_other_frames_and_of_videos_that_cannot_be_read_are_kept(frames):
    assert (frames.videos, len(frames.errors)) == (["cam.mp4"], 1)
    assert frames.keyframes == {"anna": {0: BOX}}
    moved = Box(1.0, 2.0, 30.0, 40.0)
    frames.set_boxes({"anna": {0: moved}})
    others = [("anna", 2, BOX), ("ben", 0, None)]
    assert frames.boxes == {"broken.mp4": [("ben", 0, BOX)], "cam.mp4": [*others, ("anna", 0, moved)]}
    frames.set_boxes({})
    assert frames.boxes["cam.mp4"] == others
    assert frames.missing() == []
