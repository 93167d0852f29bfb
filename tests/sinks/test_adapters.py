"""Tracks for other libraries."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest

import catstream
from catstream.box import Box
from catstream.messages.kinds import Track

PRESENT = Track(3, 2, 0.1, "present", Box(10.0, 20.0, 30.0, 40.0), 1.25, 7)
ABSENT = Track(3, 2, 0.1, "absent", None, 0.1, 7)

needs_supervision = pytest.mark.skipif(
    importlib.util.find_spec("supervision") is None,
    reason="supervision is missing: .ci/run installs it without its opencv-python",
)


@needs_supervision
def test_a_track_is_one_detection_of_supervision():
    found = catstream.to_supervision(PRESENT)
    assert np.array_equal(found.xyxy, [[10, 20, 40, 60]])
    assert (found.confidence, found.class_id, found.tracker_id) == (1, 0, 1)
    assert {name: list(values) for name, values in found.data.items()} == {
        "frame": [2],
        "state": ["present"],
        "model_version": [7],
        "object": [""],
    }


@needs_supervision
def test_the_objects_of_a_frame_are_detections_with_numbers_that_stay():
    tracks = [
        replace(PRESENT, object="anna"),
        replace(ABSENT, object="ben"),
        Track(3, 2, 0.1, "present", Box(1.0, 2.0, 3.0, 4.0), 0.8, 6, object="carl"),
    ]
    found, later = catstream.to_supervision(tracks), catstream.to_supervision(reversed(tracks))
    assert list(found.data["object"]) == ["anna", "carl"]
    assert np.array_equal(found.xyxy, [[10, 20, 40, 60], [1, 2, 4, 6]])
    assert len({*found.tracker_id}) == 2
    assert list(later.tracker_id) == list(found.tracker_id[::-1])
    assert len(catstream.to_supervision([])) == 0
    assert catstream.to_supervision({track.object: track for track in tracks}) == found


@needs_supervision
def test_an_absent_object_is_no_detection_and_both_can_be_drawn_and_filtered():
    import supervision

    absent, present = map(catstream.to_supervision, (ABSENT, PRESENT))
    assert len(absent) == 0
    assert len(present[present.confidence > 0.5]) == 1
    image = np.zeros((80, 80, 3), np.uint8)
    drawn = [supervision.BoxAnnotator().annotate(image.copy(), each) for each in (absent, present)]
    assert not drawn[0].any()
    assert drawn[1].any()


def test_a_missing_supervision_is_an_error_with_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", None)
    with pytest.raises(ImportError, match=r'pip install "catstream\[supervision\]"'):
        catstream.to_supervision(ABSENT)
