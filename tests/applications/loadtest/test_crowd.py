"""The rendered video of several objects, and its truth."""

from itertools import combinations

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
    for box in boxes.values():
        assert 0 <= box.x <= box.x + box.w <= SIZE[0]
        assert 0 <= box.y <= box.y + box.h <= SIZE[1]
    assert all(a.overlap(b) == 0 for a, b in combinations(boxes.values(), 2))


def test_some_objects_leave_and_come_back():
    seen = [boxes["carla"] is not None for _, boxes in render(3, 60)]
    assert seen[0]
    assert seen[-1]
    assert not all(seen)
