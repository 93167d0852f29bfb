"""Windows: features around a box, the score of every window in them, and the best of those.

A window is 8 x 8 cells. Features are computed on an image that is resized until
the object's box is as large as a window, its aspect with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from catstream.box import Box
from catstream.features.cells import Cells
from catstream.features.hog import CELL, MARGIN, WINDOW
from catstream.features.pyramid import Pyramid

__all__ = ["Scored", "around", "peaks", "vertex", "whole"]


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Features of a part of a frame at one scale, and the score of each window in them.

    cells    of rows x columns
    scores   float32 (rows - 7, columns - 7), of the window whose first cell is there
    origin   where the first cell's corner lies in the frame, (x, y) in pixels
    step     pixels of the frame a cell is wide and high
    """

    cells: Cells
    scores: np.ndarray
    origin: tuple[float, float]
    step: tuple[float, float]

    def box(self, row: float, column: float) -> Box:
        """Box of the window at (row, column), which may lie between cells."""
        (x, y), (w, h) = self.origin, self.step
        return Box(x + column * w, y + row * h, WINDOW * w, WINDOW * h)

    def place(self, box: Box) -> tuple[float, float]:
        """Row and column, between the cells, of the window that has a box's centre: what `box` turns back."""
        (x, y), (w, h), (left, top) = box.centre, self.step, self.origin
        return (y - top) / h - WINDOW / 2, (x - left) / w - WINDOW / 2

    def row(self, row: int, column: int) -> np.ndarray:
        """Feature row of the window at (row, column), float32 (d,)."""
        return self.cells.row(row, column)

    def refined(self, row: int, column: int) -> tuple[float, float]:
        """The peak at (row, column) between the cells, by a parabola in each direction."""
        scores = self.scores
        down = vertex(scores[:, column], row)
        across = vertex(scores[row], column)
        return row + down, column + across


def around(frame: Pyramid, box: Box, cells: int) -> tuple[Cells, tuple[float, float], tuple[float, float]]:
    """Features of `cells` x `cells` cells around a box, at the size that makes the box a window.

    Returns
    -------
    the cells; origin and step as in `Scored`
    """
    step = box.w / WINDOW, box.h / WINDOW
    x, y = box.centre
    patch = frame.cut(x, y, step[0] / CELL, step[1] / CELL, (cells + 2 * MARGIN) * CELL)
    return Cells.within(patch), (x - cells / 2 * step[0], y - cells / 2 * step[1]), step


def whole(frame: Pyramid, box: Box) -> tuple[Cells, tuple[float, float], tuple[float, float]]:
    """Features of the whole frame, resized so that `box` is as large as a window.

    Returns
    -------
    the cells; origin and step as in `Scored`
    """
    width, height = frame.size
    columns = max(WINDOW, round(width / box.w * WINDOW))
    rows = max(WINDOW, round(height / box.h * WINDOW))
    size = (columns * CELL, rows * CELL)
    scale = min(width / size[0], height / size[1])
    image, wide = frame.near(scale)
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR)
    return Cells.of(resized), (0.0, 0.0), (image.shape[1] * wide / columns, image.shape[0] * wide / rows)


def peaks(scores: np.ndarray, most: int, apart: int, least: float = -np.inf) -> list[tuple[int, int]]:
    """The highest windows, each more than `apart` cells from any higher one: non-maximum suppression.

    Returns
    -------
    up to `most` pairs (row, column) with a score above `least`, highest first
    """
    left = scores.copy()
    found = []
    for _ in range(most):
        row, column = divmod(int(left.argmax()), left.shape[1])
        if not left[row, column] > least:
            break
        found.append((row, column))
        left[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -np.inf
    return found


def vertex(values: np.ndarray, i: int) -> float:
    """Offset of the top of the parabola through three neighbours, -0.5 to 0.5."""
    if not 0 < i < len(values) - 1:
        return 0.0
    before, here, after = float(values[i - 1]), float(values[i]), float(values[i + 1])
    bend = before - 2 * here + after
    return float(np.clip((before - after) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
