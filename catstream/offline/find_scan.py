"""The search of a frame for the objects of several models.

All models share one grid of sizes and aspect ratios. For each entry of the grid, a frame is resized and its cells are
computed once, for all models whose objects may have this size and shape.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.client.saved_model import SavedModel
from catstream.detection.context import FrameContext
from catstream.detection.search import SAME_OVERLAP, fit_extent
from catstream.detection.search import Detection as Candidate
from catstream.detection.similarity import Similarity
from catstream.features.cells import Cells
from catstream.features.layout import CELL, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.wire.messages import Model

#: The minimum score of a detection.
THRESHOLD = 0.5

_SIZES = (0.4, 2.5)  # smallest and largest searched size, as multiples of the learned size
_SIZE_STEP = 1.25  # ratio of successive sizes of the grid
_ASPECT_STEP = 1.25  # ratio of successive aspect ratios
_MOST_PIXELS = 4_000_000  # maximum size of a resized frame, which bounds the cost for a tiny object in a large frame
_WIDEST = 1.25  # maximum side of a window, as a multiple of the frame's: its object fills the frame
_SMALLEST = 24  # minimum side of a window in pixels: smaller windows contain too little detail
_MOST_MAXIMA = 8  # maximum number of examined windows of one size, and of detections of one object in a frame
_FITTED = 0.7  # minimum score of a fitted window, as a share of the threshold: fitting raises scores by less


@dataclass(frozen=True, slots=True)
class Match:
    """A window with an object, the object's box, and the score: see `Scan`."""

    window: Window
    box: Box
    score: float


@dataclass(frozen=True, slots=True)
class _Template:
    """A model, its measure of similarity, a window of the learned size, and its settings."""

    model: Model
    similarity: Similarity
    window: Window
    settings: Settings

    def match(self, scores: ScoreMap, row: int, column: int, window: Window) -> Match:
        """The match of a window with its features at (row, column) of a map of appearance scores."""
        score = min(1.0, float(scores.scores[row, column])) * self.similarity(scores.cells.row(row, column))
        return Match(window, window.box(), score)


class Scan:
    """Searches frames for the objects of several models.

    The score of a window is its similarity to the object (see `catstream.detection.similarity`) times the score of the
    appearance model, clipped at 1: about 1 on the object, and near 0 on an unknown background.

    threshold : minimum score of a detection
    """

    def __init__(self, models: Iterable[SavedModel], threshold: float = THRESHOLD) -> None:
        self._threshold = threshold
        self._templates = [
            _Template(saved.model, saved.similarity(), Window.around(saved.box), saved.settings) for saved in models
        ]
        self._grid: dict[tuple[int, int], list[int]] = defaultdict(list)  # indices of models by entry
        for number, template in enumerate(self._templates):
            for entry in _entries(template.window):
                self._grid[entry].append(number)

    @one_thread()
    def __call__(self, image: np.ndarray) -> list[list[Match]]:
        """Search a frame, uint8 (h, w, 3): for each model, fitted windows without overlap, best first."""
        frame = Pyramid(image)
        results = []
        for template, windows in zip(self._templates, self.windows(frame), strict=True):
            matches = (_fitted(frame, candidate.window, template) for candidate in windows)
            results.append(_suppressed(match for match in matches if match.score >= self._threshold))
        return results

    def windows(self, frame: Pyramid) -> list[list[Match]]:
        """For each model, the best windows of the grid, highest score first."""
        matches: list[list[Match]] = [[] for _ in self._templates]
        for entry, numbers in self._grid.items():
            window = _window(*entry)
            if not _is_searchable(window, frame.size):
                continue
            image, step = frame.resized(window, averaged=False)
            cells = Cells.of(image)
            for number in numbers:
                matches[number] += self._maxima(cells, step, self._templates[number])
        return [_suppressed(of_model) for of_model in matches]

    def _maxima(self, cells: Cells, step: tuple[float, float], template: _Template) -> list[Match]:
        """The best windows of one size, with cells of `step` pixels."""
        minimum = _FITTED * self._threshold
        model = template.model
        # The similarity is at most 1 / share.
        appearance = cells.respond_above(model.weights, model.bias, minimum * template.similarity.share)
        scores = ScoreMap(cells, appearance, (0.0, 0.0), step)
        positions = non_maximum_suppression(appearance, _MOST_MAXIMA, WINDOW // 2)
        matches = [template.match(scores, *position, scores.window(*position)) for position in positions]
        return [match for match in matches if match.score >= minimum]


def _fitted(frame: Pyramid, window: Window, template: _Template) -> Match:
    """Fit the size and aspect ratio of a window, with the learned aspect ratio as the prior."""
    size = math.sqrt(window.area / template.window.area)
    likely = template.window.scaled(size).centred(*window.centre)
    context = FrameContext(frame, template.model, template.settings)
    best = fit_extent(context, Candidate(0.0, window), likely).window
    return template.match(ScoreMap.around(frame, best, WINDOW, template.model), 0, 0, best)


def _entries(window: Window) -> list[tuple[int, int]]:
    """The searched entries of the grid, exponents of size and aspect ratio, for the learned window."""
    low, high = (math.log(math.sqrt(window.area) * size, _SIZE_STEP) for size in _SIZES)
    aspect = round(math.log(window.w / window.h, _ASPECT_STEP))
    return [(size, aspect) for size in range(math.ceil(low), math.floor(high) + 1)]


def _window(size: int, aspect: int) -> Window:
    """The window of an entry of the grid."""
    side, stretch = _SIZE_STEP**size, math.sqrt(_ASPECT_STEP**aspect)
    return Window(0.0, 0.0, side * stretch, side / stretch)


def _is_searchable(window: Window, size: tuple[int, int]) -> bool:
    """Return True if a window is neither too small nor too large for a frame."""
    (width, height), side = size, WINDOW * CELL
    if window.w > _WIDEST * width or window.h > _WIDEST * height or window.area < _SMALLEST**2:
        return False
    return width * side / window.w * height * side / window.h <= _MOST_PIXELS


def _suppressed(matches: Iterable[Match]) -> list[Match]:
    """Non-maximum suppression: windows without overlap with a better one, highest score first."""
    best: list[Match] = []
    for match in sorted(matches, key=lambda match: -match.score):
        if len(best) < _MOST_MAXIMA and all(match.window.overlap(other.window) < SAME_OVERLAP for other in best):
            best.append(match)
    return best
