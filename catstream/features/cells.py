"""Cells: the features of an image in a grid of cells, and the score of every window in it.

A window is 8 x 8 cells. Its feature row holds their HOG and mean colours, and the histogram of its colours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from catstream.arrays import Float32
from catstream.features import colours
from catstream.features.compiled import kernel
from catstream.features.hog import grid
from catstream.features.layout import CELL, CHANNELS, COLOURS, MARGIN, WINDOW, row_length

__all__ = ["Cells"]

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
        return cls(grid(image), colours.shades(image))

    @classmethod
    def within(cls, image: np.ndarray) -> Cells:
        """The same without the margin, whose features depend on pixels beyond the image."""
        edge = MARGIN * CELL
        return cls(grid(image, MARGIN), colours.shades(image[edge:-edge, edge:-edge]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.grid.shape[:2]
        return rows, columns

    def row(self, row: int, column: int) -> np.ndarray:
        """Feature row of the window whose first cell is (row, column), float32 (d,)."""
        features = np.empty(row_length(), np.float32)
        features[:_PLACES] = self.grid[row : row + WINDOW, column : column + WINDOW].reshape(-1)
        colours.histogram(self.shades, row, column, features[COLOURS])
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
        takes a third of the time of `respond` if few windows score that high.
        """
        reach = least - colours.highest_score(weights[COLOURS])
        scores = self._places(weights, bias)
        hopeless = scores < reach
        colours.add_scores(self.shades, weights[COLOURS], scores, reach)
        scores[hopeless | (scores < least)] = -np.inf
        return scores

    def _places(self, weights: np.ndarray, bias: float) -> np.ndarray:
        """Score of every window without its histogram of colours: one matrix product and shifted sums."""
        rows, columns = self.shape
        parts = self.grid.reshape(-1, CHANNELS) @ weights[:_PLACES].reshape(-1, CHANNELS).T
        scores = np.full((rows - WINDOW + 1, columns - WINDOW + 1), bias, np.float32)
        _add_shifted(parts.reshape(rows, columns, WINDOW * WINDOW), scores)
        return scores


@kernel("void(float32[:,:,::1], float32[:,::1])")
def _add_shifted(parts: Float32, scores: Float32) -> None:
    rows, columns = scores.shape
    for row in range(rows):
        for column in range(columns):
            total = np.float32(0)
            for i in range(WINDOW):
                for j in range(WINDOW):
                    total += parts[row + i, column + j, i * WINDOW + j]
            scores[row, column] += total
