"""Cells: the features of an image in a grid of cells, and the score of every window in it.

A window is 8 x 8 cells. Its feature row holds their HOG and mean colours, and the histogram of its colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catstream.features import colours
from catstream.features.colours import count
from catstream.features.compiled import kernel
from catstream.features.hog import grid
from catstream.features.layout import CELL, CHANNELS, COLOURS, MARGIN, WINDOW, row_length
from catstream.features.pyramid import planes_of
from catstream.numerics.arrays import Float32, Int64, UInt16, writable

_PLACES = COLOURS.start  # features of the cells of a window, before those of its colours


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Features of a part of an image, cell by cell.

    grid    float32 (rows, columns, 34), HOG and mean colour
    shades  uint16 (4 * rows, 4 * columns), 4 x 4 of each cell
    """

    grid: np.ndarray
    shades: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray) -> Cells:
        """Cells of an image, uint8 (h, w, 3) BGR, whose sides are whole cells."""
        planes = planes_of(image)
        return cls(grid(planes), colours.shades(planes))

    @classmethod
    def within(cls, planes: np.ndarray) -> Cells:
        """Cells of a patch, uint8 (3, h, w), without the margin, whose features depend on pixels beyond it."""
        edge = MARGIN * CELL
        return cls(grid(planes, MARGIN), colours.shades(planes[:, edge:-edge, edge:-edge]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.grid.shape[:2]
        return rows, columns

    def row(self, row: int, column: int) -> np.ndarray:
        """Feature row of the window whose first cell is (row, column), float32 (d,)."""
        features: np.ndarray = self.rows([(row, column)])[0]
        return features

    def rows(self, places: Sequence[tuple[int, int]]) -> np.ndarray:
        """Feature rows of the windows whose first cells are at (row, column), float32 (k, d)."""
        features = np.empty((len(places), row_length()), np.float32)
        _cut(self.grid.reshape(len(self.grid), -1), self.shades, np.array(places, np.int64).reshape(-1, 2), features)
        return features

    def respond(self, weights: np.ndarray, bias: float) -> np.ndarray:
        """Score of every window, float32 (rows - 7, columns - 7).

        Parameters
        ----------
        weights : float32 (d,)
        """
        scores = self._places(weights, bias)
        colours.add_scores(self.shades, weights[COLOURS], scores)
        return scores

    def respond_above(self, weights: np.ndarray, bias: float, least: float) -> np.ndarray:
        """The same scores, but -inf for every window whose score is below `least`.

        The colours of a window are not counted if its score would be below `least` with any histogram of colours: this
        takes three quarters of the time of `respond` if few windows score that high.
        """
        reach = least - colours.highest_score(weights[COLOURS])
        scores = self._places(weights, bias)
        hopeless = scores < reach
        colours.add_scores(self.shades, weights[COLOURS], scores, reach)
        scores[hopeless | (scores < least)] = -np.inf
        return scores

    def _places(self, weights: np.ndarray, bias: float) -> np.ndarray:
        """Score of every window without its histogram of colours."""
        rows, columns = self.shape
        scores = np.empty((rows - WINDOW + 1, columns - WINDOW + 1), np.float32)
        scores.fill(bias)
        _add_scores(self.grid.reshape(rows, -1), writable(weights[:_PLACES]).reshape(WINDOW, -1), scores)
        return scores


@kernel("void(float32[:,::1], uint16[:,::1], int64[:,::1], float32[:,::1])")
def _cut(grid: Float32, shades: UInt16, places: Int64, features: Float32) -> None:
    """Feature rows of the windows whose first cells are at `places`."""
    for k in range(len(places)):
        row, column = places[k, 0], places[k, 1]
        for i in range(WINDOW):
            cells = grid[row + i, column * CHANNELS : (column + WINDOW) * CHANNELS]
            line = features[k, i * WINDOW * CHANNELS : (i + 1) * WINDOW * CHANNELS]
            for j in range(WINDOW * CHANNELS):
                line[j] = cells[j]
        count(shades, row, column, features[k, _PLACES:])


@kernel("void(float32[:,::1], float32[:,::1], float32[:,::1])")
def _add_scores(grid: Float32, weights: Float32, scores: Float32) -> None:
    """Add the products of each row of cells, (34 columns,), with each row of the windows that it lies in."""
    for row in range(len(grid)):
        for column in range(scores.shape[1]):
            cells = grid[row, column * CHANNELS : (column + WINDOW) * CHANNELS]
            for i in range(max(row - len(scores) + 1, 0), min(row + 1, WINDOW)):
                line, total = weights[i], np.float32(0)
                for j in range(WINDOW * CHANNELS):
                    total += cells[j] * line[j]
                scores[row - i, column] += total
