"""The objects of a load test."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.applications.loadtest.objects import several
from catstream.applications.loadtest.plan import Plan
from catstream.errors import ObjectError, SettingsError
from catstream.multi import MultiTracker
from catstream.video.demo import render

((IMAGE, BOX),) = render(1, (320, 240))


def test_all_objects_can_be_tracked_and_none_overlaps_the_first():
    boxes = several(IMAGE, BOX, 8)
    assert len(boxes) == 8
    assert boxes.pop("") == BOX
    assert not any(box.overlap(BOX) for box in boxes.values())
    tracker = MultiTracker()
    tracker.init(IMAGE, boxes)
    assert tracker.update(IMAGE).keys() == boxes.keys()


def test_an_image_without_room_for_all_objects_is_an_error():
    with pytest.raises(SettingsError, match="has room for 1 objects, not 2"):
        several(np.zeros((120, 160, 3), np.uint8), BOX, 2)


def test_a_plan_has_at_most_as_many_objects_as_the_settings_allow():
    assert "8 objects" in str(Plan(objects=8))
    with pytest.raises(ObjectError, match="99 objects are more than 32"):
        Plan(objects=99)
