"""Boxes from texts and numbers."""

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.errors import BoxError


@pytest.mark.parametrize(
    "value",
    ["10,20,30,40", " 10 20\t30, 40", (10, 20, 30, 40), np.array([10, 20, 30, 40]), iter([10, 20, 30, 40])],
    ids=["commas", "blanks", "tuple", "array", "iterator"],
)
def test_box_is_parsed_from_a_text_and_from_any_four_numbers(value):
    assert Box.parse(value) == Box(10.0, 20.0, 30.0, 40.0)


@pytest.mark.parametrize(
    "value",
    ["10,20,30", "a,b,c,d", "", (10, 20, 30), [[1, 2], [3, 4]], None, 7, (10, 20, None, 40), np.zeros((480, 640, 3))],
    ids=lambda value: repr(value)[:9],
)
def test_invalid_box_is_a_short_error_with_an_example(value):
    message = r"a box is four numbers x,y,w,h in pixels, got .{,130}: for example 120,80,64,48$"
    with pytest.raises(BoxError, match=message):
        Box.parse(value)


def test_cv2_draws_a_rounded_box():
    frame = np.zeros((60, 80, 3), np.uint8)
    cv2.rectangle(frame, Box(10.4, 19.6, 30.4, 10.2).rounded(), (255, 255, 255), cv2.FILLED)
    rows, columns = np.nonzero(frame[:, :, 0])
    assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == (10, 20, 41, 30)
