"""Windows: cuts, grids, scores and peaks."""

import numpy as np
import pytest

from catstream.box import Box
from catstream.detection import windows
from catstream.detection.windows import Scored
from catstream.features.cells import Cells
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid


@pytest.fixture
def image(rng):
    return rng.integers(0, 256, (200, 240, 3), np.uint8)


def test_cells_around_a_box_are_those_of_the_frame(image):
    cells, origin, step = windows.around(Pyramid(image), Box(64, 48, 64, 64), 12)
    frames = Cells.of(image)
    np.testing.assert_array_equal(cells.grid, frames.grid[4:16, 6:18])
    np.testing.assert_array_equal(cells.shades, frames.shades[16:64, 24:72])
    assert (origin, step) == ((48, 32), (8, 8))


def test_the_window_of_a_score_is_a_box_in_the_frame(image):
    box = Box(30, 40, 50, 70)
    cells, origin, step = windows.around(Pyramid(image), box, 20)
    found = Scored(cells, np.zeros((13, 13), np.float32), origin, step).box(6, 6)
    assert found == pytest.approx(box)


def test_a_whole_frame_is_resized_until_the_box_is_a_window(image):
    cells, origin, step = windows.whole(Pyramid(image), Box(10, 10, 40, 50))
    assert cells.shape == (200 // 50 * WINDOW, 240 // 40 * WINDOW)
    assert (origin, step) == ((0, 0), (5, 6.25))


def test_a_peak_lies_between_cells_where_its_neighbours_say(image):
    row, column = np.mgrid[:9, :9]
    scores = (1 - 0.01 * ((row - 4.3) ** 2 + (column - 3.8) ** 2)).astype(np.float32)
    scored = Scored(Cells.of(image[:128, :128]), scores, (0, 0), (1, 1))
    assert scored.refined(4, 4) == pytest.approx((4.3, 3.8), abs=1e-3)


def test_peaks_suppress_their_neighbours(rng):
    scores = rng.normal(size=(30, 40)).astype(np.float32)
    found = windows.peaks(scores, 12, apart=3)
    values = [scores[place] for place in found]
    assert values == sorted(values, reverse=True)
    assert values[0] == scores.max()
    for i, (row, column) in enumerate(found):
        assert all(max(abs(row - r), abs(column - c)) > 3 for r, c in found[:i])


def test_peaks_stop_at_the_threshold():
    assert windows.peaks(np.eye(5, dtype=np.float32), 9, apart=1, least=0.5) == [(0, 0), (2, 2), (4, 4)]
