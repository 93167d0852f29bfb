"""Search: the features and the score of every window in a part of a frame, and the highest of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Window
from catstream.detection.search import due_part
from catstream.features.cells import Cells
from catstream.features.pyramid import Pyramid, Region
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.wire.messages import Model


def test_window_and_place_of_a_score_are_inverse(image):
    window = Window(30, 40, 50, 70)
    scores = ScoreMap.around(Pyramid(image), window, 20, None)
    assert scores.window(6, 6) == pytest.approx(window)
    assert scores.position(scores.window(2.25, 7.5)) == pytest.approx((2.25, 7.5))


def test_windows_of_a_region_lie_in_it(image, rng):
    model = Model(1, 0, rng.normal(size=len(Cells.of(image).row(0, 0))).astype(np.float32), 0.0)
    scores = ScoreMap.within(Pyramid(image), Region(40, 20, 100, 90), Window(0, 0, 40, 40), model)
    assert scores.origin == (40, 20)
    last = scores.window(*np.subtract(scores.scores.shape, 1))
    assert (last.x + last.w, last.y + last.h) == pytest.approx((140, 110))


@given(st.integers(0, 10**6), st.integers(1, 30), st.integers(1, 60))
def test_each_part_is_searched_once_in_an_interval(seq, interval, count):
    frames = max(interval, count)
    parts = [part for number in range(seq, seq + frames) if (part := due_part(number, interval, count)) is not None]
    assert sorted(parts) == list(range(count))


def test_maximum_between_cells_is_interpolated(image):
    row, column = np.mgrid[:9, :9]
    scores = (1 - 0.01 * ((row - 4.3) ** 2 + (column - 3.8) ** 2)).astype(np.float32)
    found = ScoreMap(Cells.of(image[:128, :128]), scores, (0, 0), (1, 1))
    _, window = found.best()
    assert (window.y, window.x) == pytest.approx((4.3, 3.8), abs=1e-3)


def test_maxima_suppress_their_neighbours(rng):
    scores = rng.normal(size=(30, 40)).astype(np.float32)
    found = non_maximum_suppression(scores, 12, radius=3)
    values = [scores[place] for place in found]
    assert values == sorted(values, reverse=True)
    assert values[0] == scores.max()
    for i, (row, column) in enumerate(found):
        assert all(max(abs(row - r), abs(column - c)) > 3 for r, c in found[:i])
    assert non_maximum_suppression(np.eye(5, dtype=np.float32), 9, radius=1, threshold=0.5) == [(0, 0), (2, 2), (4, 4)]
