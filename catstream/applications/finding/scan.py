"""The scan: the windows of a frame that show the objects of saved models.

All models are searched on one grid of sizes and aspect ratios. For each entry of the grid, the frame is resized and its
cells are computed once, for all models whose objects may have this size and shape.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from catstream.box import Box, Window
from catstream.detection.likeness import Likeness
from catstream.detection.search import SAME_OVERLAP, Detection, fitted
from catstream.features.cells import Cells
from catstream.features.layout import CELL, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.messages.kinds import Model
from catstream.numerics.threads import one_thread
from catstream.run.learned import Learned
from catstream.settings import Settings

#: The least score of a sighting.
THRESHOLD = 0.5
#: The smallest and the largest size that is searched, as multiples of the learned size.
SIZES = (0.4, 2.5)

_SIZE_STEP = 1.25  # ratio of successive sizes of the grid
_ASPECT_STEP = 1.25  # ratio of successive aspect ratios
_MOST_PIXELS = 4_000_000  # of a resized frame: bounds the cost of a search for a tiny object in a large frame
_WIDEST = 1.25  # of a window, as a multiple of the frame: its object fills the frame
_SMALLEST = 24  # side of a window in pixels: a smaller one shows too little of its object
_MOST_MAXIMA = 8  # windows of one size that are examined, and sightings of one object in a frame
_FITTED = 0.7  # share of the threshold from which a window is fitted: its score rises by less


@dataclass(frozen=True, slots=True)
class Seen:
    """A window that shows an object, the object's box in it, and the score: see `Scan`."""

    window: Window
    box: Box
    score: float


@dataclass(frozen=True, slots=True)
class _Searched:
    """A model, its measure of likeness, a window of the learned size, and the settings that it was learned with."""

    model: Model
    likeness: Likeness
    window: Window
    settings: Settings

    def seen(self, scores: ScoreMap, row: int, column: int, window: Window) -> Seen:
        """A window whose features are at (row, column) of a map of appearance scores."""
        score = min(1.0, float(scores.scores[row, column])) * self.likeness(scores.cells.row(row, column))
        return Seen(window, window.box(self.settings.search.context), score)


class Scan:
    """Searches frames for the objects of several models.

    The score of a window is its likeness to the object (see `catstream.detection.likeness`) times the score of the
    appearance model, of which at most 1 counts: about 1 on the object, and near 0 on an unknown background.

    threshold : least score of a sighting
    sizes : smallest and largest size, as multiples of the learned size
    """

    def __init__(
        self, learned: Iterable[Learned], threshold: float = THRESHOLD, sizes: tuple[float, float] = SIZES
    ) -> None:
        self._threshold = threshold
        self._models = [
            _Searched(each.model, each.likeness(), Window.around(each.box, each.settings.search.context), each.settings)
            for each in learned
        ]
        self._grid: dict[tuple[int, int], list[int]] = defaultdict(list)  # entry -> numbers of the models
        for number, searched in enumerate(self._models):
            for entry in _entries(searched.window, sizes):
                self._grid[entry].append(number)

    @one_thread()
    def __call__(self, image: np.ndarray) -> list[list[Seen]]:
        """Search a frame, uint8 (h, w, 3): for each model, fitted windows that do not overlap, best first."""
        frame = Pyramid(image)
        found = []
        for searched, windows in zip(self._models, self.windows(frame), strict=True):
            seen = [_fitted(frame, each.window, searched) for each in windows]
            found.append(_suppressed(each for each in seen if each.score >= self._threshold))
        return found

    def windows(self, frame: Pyramid) -> list[list[Seen]]:
        """For each model, the best windows of the grid, highest score first."""
        found: list[list[Seen]] = [[] for _ in self._models]
        for entry, numbers in self._grid.items():
            window = _window(*entry)
            if not _is_searchable(window, frame.size):
                continue
            image, step = frame.resized(window, averaged=False)
            cells = Cells.of(image)
            for number in numbers:
                found[number] += self._maxima(cells, step, self._models[number])
        return [_suppressed(each) for each in found]

    def _maxima(self, cells: Cells, step: tuple[float, float], searched: _Searched) -> list[Seen]:
        """The best windows of one size, whose cells are `step` pixels wide and high."""
        least = _FITTED * self._threshold
        # No likeness is above 1 / share.
        appearance = cells.respond_above(searched.model.weights, searched.model.bias, least * searched.likeness.share)
        scores = ScoreMap(cells, appearance, (0.0, 0.0), step)
        places = non_maximum_suppression(appearance, _MOST_MAXIMA, WINDOW // 2)
        found = [searched.seen(scores, *place, scores.window(*place)) for place in places]
        return [each for each in found if each.score >= least]


def _fitted(frame: Pyramid, window: Window, searched: _Searched) -> Seen:
    """A window at its best size and aspect ratio; the learned aspect ratio is likelier than others."""
    size = math.sqrt(window.area / searched.window.area)
    likely = searched.window.scaled(size).centred(*window.centre)
    found = fitted(frame, Detection(0.0, window), likely, searched.model, searched.settings.extent)
    return searched.seen(ScoreMap.around(frame, found.window, WINDOW, searched.model), 0, 0, found.window)


def _entries(window: Window, sizes: tuple[float, float]) -> list[tuple[int, int]]:
    """The entries of the grid, exponents of size and aspect ratio, at which the object of a window is searched."""
    low, high = (math.log(math.sqrt(window.area) * size, _SIZE_STEP) for size in sizes)
    aspect = round(math.log(window.w / window.h, _ASPECT_STEP))
    return [(size, aspect) for size in range(math.ceil(low), math.floor(high) + 1)] or [(round(low), aspect)]


def _window(size: int, aspect: int) -> Window:
    """The window of an entry of the grid."""
    side, stretch = _SIZE_STEP**size, math.sqrt(_ASPECT_STEP**aspect)
    return Window(0.0, 0.0, side * stretch, side / stretch)


def _is_searchable(window: Window, size: tuple[int, int]) -> bool:
    """Whether windows of a size are neither too small to show anything nor too large for a frame."""
    (width, height), side = size, WINDOW * CELL
    if window.w > _WIDEST * width or window.h > _WIDEST * height or window.area < _SMALLEST**2:
        return False
    return width * side / window.w * height * side / window.h <= _MOST_PIXELS


def _suppressed(found: Iterable[Seen]) -> list[Seen]:
    """The windows that overlap no better one, highest score first."""
    kept: list[Seen] = []
    for each in sorted(found, key=lambda one: -one.score):
        if len(kept) < _MOST_MAXIMA and all(each.window.overlap(other.window) < SAME_OVERLAP for other in kept):
            kept.append(each)
    return kept
