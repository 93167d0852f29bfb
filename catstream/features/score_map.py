"""The scores of all windows of a part of a frame at one scale, with the features from which they were computed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from catstream.base.box import Window
from catstream.features.cells import Cells
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid, Region
from catstream.wire.messages import Model


@dataclass(frozen=True, slots=True, eq=False)
class ScoreMap:
    """Features of a part of a frame at one scale, and the scores of all windows in them.

    cells   features, of rows x columns
    scores  float32 (rows - 7, columns - 7), by the index of the first cell of a window
    origin  corner of the first cell in the frame, (x, y) in pixels
    step    width and height of a cell, in pixels of the frame
    """

    cells: Cells
    scores: np.ndarray
    origin: tuple[float, float]
    step: tuple[float, float]

    @classmethod
    def around(cls, frame: Pyramid, window: Window, side: int, model: Model | None) -> ScoreMap:
        """All windows in `side` x `side` cells around a window, of its size; without a model all scores are 0."""
        cells = Cells.within(frame.around(window, side))
        if model is None:
            scores = np.zeros((side - WINDOW + 1,) * 2, np.float32)
        else:
            scores = cells.respond(model.weights, model.bias)
        x, y = window.centre
        step = window.w / WINDOW, window.h / WINDOW
        return cls(cells, scores, (x - side / 2 * step[0], y - side / 2 * step[1]), step)

    @classmethod
    def within(cls, frame: Pyramid, region: Region, window: Window, model: Model) -> ScoreMap:
        """All windows of a size in a region of a frame."""
        image, step = frame.part(region).resized(window)
        cells = Cells.of(image)
        return cls(cells, cells.respond(model.weights, model.bias), (float(region.left), float(region.top)), step)

    def window(self, row: float, column: float) -> Window:
        """The window at (row, column), which may lie between cells."""
        (x, y), (w, h) = self.origin, self.step
        return Window(x + column * w, y + row * h, WINDOW * w, WINDOW * h)

    def position(self, window: Window) -> tuple[float, float]:
        """Row and column, in fractions, of the window with the same centre: the inverse of `window`."""
        x, y = window.centre
        w, h = self.step
        left, top = self.origin
        return (y - top) / h - WINDOW / 2, (x - left) / w - WINDOW / 2

    def argmax(self, penalty: np.ndarray | float = 0.0) -> tuple[int, int]:
        """Row and column of the window with the highest score less a penalty."""
        row, column = divmod(int((self.scores - penalty).argmax()), self.scores.shape[1])
        return row, column

    def best(self, penalty: np.ndarray | float = 0.0) -> tuple[float, Window]:
        """The window with the highest score less a penalty, after its score.

        The position of the window is interpolated by a parabola through the neighbouring scores in both directions.
        """
        scores = self.scores
        row, column = self.argmax(penalty)
        window = self.window(row + vertex(scores[:, column], row), column + vertex(scores[row], column))
        return float(scores[row, column]), window

    def non_overlapping(self, window: Window) -> ScoreMap:
        """The same map, with the score -inf for all windows that overlap another one."""
        (x, y), (w, h) = self.origin, self.step
        rows, columns = self.scores.shape
        top = y + h * np.arange(rows)
        left = x + w * np.arange(columns)
        above_or_below = (top >= window.y + window.h) | (top + WINDOW * h <= window.y)
        left_or_right = (left >= window.x + window.w) | (left + WINDOW * w <= window.x)
        return replace(self, scores=np.where(above_or_below[:, None] | left_or_right, self.scores, np.float32(-np.inf)))


def non_maximum_suppression(
    scores: np.ndarray, count: int, radius: int, threshold: float = -np.inf
) -> list[tuple[int, int]]:
    """Return up to `count` windows with a score above a threshold, as (row, column), highest score first.

    A window suppresses all others up to `radius` cells away.
    """
    scores = scores.copy()
    maxima = []
    for _ in range(count):
        row, column = divmod(int(scores.argmax()), scores.shape[1])
        if not scores[row, column] > threshold:
            break
        maxima.append((row, column))
        scores[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1] = -np.inf
    return maxima


def vertex(values: np.ndarray, i: int) -> float:
    """Offset of the vertex of the parabola through value i and its two neighbours, -0.5 to 0.5."""
    if not 0 < i < len(values) - 1:
        return 0.0
    before, value, after = float(values[i - 1]), float(values[i]), float(values[i + 1])
    curvature = before - 2 * value + after
    return min(max((before - after) / (2 * curvature), -0.5), 0.5) if curvature < 0 else 0.0
