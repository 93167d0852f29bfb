"""Search: the features and the score of every window in a part of a frame, and the highest of them."""

import numpy as np
import pytest

from catstream.box import Window
from catstream.detection.search import ScoreMap, non_maximum_suppression
from catstream.features.cells import Cells
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.messages import Model


@pytest.fixture
def image(rng):
    return rng.integers(0, 256, (200, 240, 3), np.uint8)


def test_cells_around_a_window_are_those_of_the_frame(image):
    scores, frames = ScoreMap.around(Pyramid(image), Window(64, 48, 64, 64), 12, None), Cells.of(image)
    np.testing.assert_array_equal(scores.cells.grid, frames.grid[4:16, 6:18])
    np.testing.assert_array_equal(scores.cells.shades, frames.shades[16:64, 24:72])
    assert (scores.origin, scores.step) == ((48, 32), (8, 8))


def test_the_window_of_a_score_lies_in_the_frame_and_place_is_its_inverse(image):
    window = Window(30, 40, 50, 70)
    scores = ScoreMap.around(Pyramid(image), window, 20, None)
    assert scores.window(6, 6) == pytest.approx(window)
    assert scores.place(scores.window(2.25, 7.5)) == pytest.approx((2.25, 7.5))


def test_a_whole_frame_is_resized_until_a_window_is_8_x_8_cells(image, rng):
    model = Model(1, 0, rng.normal(size=len(Cells.of(image).row(0, 0))).astype(np.float32), 0.0)
    scores = ScoreMap.whole(Pyramid(image), Window(10, 10, 40, 50), model)
    assert scores.cells.shape == (200 // 50 * WINDOW, 240 // 40 * WINDOW)
    assert (scores.origin, scores.step) == ((0, 0), (5, 6.25))


def test_of_a_frame_that_is_too_large_for_a_tiny_window_the_part_around_it_is_searched():
    image, origin, step = Pyramid(np.zeros((600, 800, 3), np.uint8)).whole(Window(396, 296, 8, 8))
    assert image.shape[0] * image.shape[1] <= 4_000_000
    assert origin[0] > 0 < origin[1]
    assert origin[0] + image.shape[1] / 8 * step[0] == pytest.approx(800 - origin[0], abs=2)


def test_a_maximum_between_cells_is_interpolated_from_its_neighbours(image):
    row, column = np.mgrid[:9, :9]
    scores = (1 - 0.01 * ((row - 4.3) ** 2 + (column - 3.8) ** 2)).astype(np.float32)
    found = ScoreMap(Cells.of(image[:128, :128]), scores, (0, 0), (1, 1))
    assert found.refined(4, 4) == pytest.approx((4.3, 3.8), abs=1e-3)


def test_maxima_suppress_their_neighbours(rng):
    scores = rng.normal(size=(30, 40)).astype(np.float32)
    found = non_maximum_suppression(scores, 12, apart=3)
    values = [scores[place] for place in found]
    assert values == sorted(values, reverse=True)
    assert values[0] == scores.max()
    for i, (row, column) in enumerate(found):
        assert all(max(abs(row - r), abs(column - c)) > 3 for r, c in found[:i])


def test_maxima_stop_at_the_threshold():
    assert non_maximum_suppression(np.eye(5, dtype=np.float32), 9, apart=1, least=0.5) == [(0, 0), (2, 2), (4, 4)]
