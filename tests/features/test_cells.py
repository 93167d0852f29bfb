"""Cells: rows and scores of every window."""

import numpy as np
import pytest

from catstream.features.cells import Cells
from catstream.features.layout import COLOURS, row_length
from catstream.features.pyramid import planes_of


@pytest.fixture
def cells(rng):
    small = rng.integers(0, 256, (22, 28, 3), np.uint8)
    return Cells.of(np.repeat(np.repeat(small, 4, axis=0), 4, axis=1))


def test_every_window_scores_weights_times_row_plus_bias(cells, rng):
    weights = rng.normal(size=row_length()).astype(np.float32)
    scores = cells.respond(weights, 0.5)
    expected = [[cells.row(row, column) @ weights + 0.5 for column in range(7)] for row in range(4)]
    np.testing.assert_allclose(scores, expected, rtol=1e-4, atol=1e-3)


def test_a_row_is_the_windows_cells_and_then_its_colours(cells):
    row = cells.row(2, 3)
    assert (row.shape, row.dtype) == ((row_length(),), np.float32)
    np.testing.assert_array_equal(row[: COLOURS.start], cells.grid[2:10, 3:11].ravel())
    assert np.linalg.norm(row[COLOURS]) == pytest.approx(3, abs=1e-5)


def test_cells_within_a_margin_are_those_of_the_larger_image(rng):
    image = rng.integers(0, 256, (128, 160, 3), np.uint8)
    whole, inner = Cells.of(image), Cells.within(planes_of(image[16:112, 24:120]))
    np.testing.assert_array_equal(inner.row(0, 0), whole.row(4, 5))


@pytest.mark.parametrize("quantile", [0.0, 0.5, 0.9, 1.0])
def test_the_scores_from_a_threshold_on_are_those_of_all_windows(cells, rng, quantile):
    weights = rng.normal(size=row_length()).astype(np.float32)
    scores = cells.respond(weights, 0.5)
    least = float(np.quantile(scores, quantile)) + 1e-3
    expected = np.where(scores >= least, scores, -np.inf)
    np.testing.assert_allclose(cells.respond_above(weights, 0.5, least), expected, rtol=1e-4, atol=1e-3)
