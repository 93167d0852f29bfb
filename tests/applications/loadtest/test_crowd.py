"""The rendered video of several objects, and its truth."""

import numpy as np
import pytest

from catstream.applications.loadtest.crowd import NAMES, SIZE, render


def test_the_same_arguments_give_the_same_pixels():
    for (image, boxes), (again, same) in zip(render(3, 4), render(3, 4), strict=True):
        assert np.array_equal(image, again)
        assert boxes == same


@pytest.mark.parametrize("count", [2, 8, 16])
def test_all_objects_begin_whole_in_the_picture_and_apart(count):
    _, boxes = next(render(count, 2))
    assert list(boxes) == list(NAMES[:count])
    assert all(
        box.x >= 0 and box.y >= 0 and box.x + box.w <= SIZE[0] and box.y + box.h <= SIZE[1] for box in boxes.values()
    )
    pairs = [(a, b) for i, a in enumerate(boxes.values()) for b in list(boxes.values())[:i]]
    assert all(a.overlap(b) == 0 for a, b in pairs)


def test_some_objects_leave_and_come_back():
    seen = [boxes["carla"] is not None for _, boxes in render(3, 60)]
    assert seen[0]
    assert seen[-1]
    assert not all(seen)
