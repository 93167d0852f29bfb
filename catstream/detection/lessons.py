"""Lessons: the rows that a frame teaches, cut around the place where the object is.

label 1, the object; 0, background; between them a near miss, which is worth
exp(-distance^2 / 2 sigma^2), so that the score falls smoothly beside the object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from catstream.box import Box
from catstream.detection import affine, extent, search, windows
from catstream.detection.windows import Scored
from catstream.features.cells import COLOURS, row_length
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.messages import Model
from catstream.settings import Settings

__all__ = ["Lesson", "far", "first", "near", "with_extents"]

_NEAR = 2  # cells around the object whose windows are near misses, not background
_NEAREST = 0.9  # cells: a window nearer than that is the object as much as its own
_CELLS = 20  # cells around the object, at least, that background is taken from


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """Rows with their labels and weights, and cuts that show how large the object is, as in `Features`."""

    rows: np.ndarray
    labels: np.ndarray
    weights: np.ndarray
    extents: np.ndarray
    fits: np.ndarray

    @classmethod
    def of(cls, rows: list[np.ndarray], label: float | list[float], weight: float = 1.0) -> Lesson:
        """Rows of one weight, with one label or each its own."""
        k = len(rows)
        none = np.empty(0, np.float32)
        return cls(_array(rows), np.full(k, label, np.float32), np.full(k, weight, np.float32), _array([]), none)

    @classmethod
    def none(cls) -> Lesson:
        """A frame that teaches nothing."""
        return cls.of([], 0)

    def __add__(self, other: Lesson) -> Lesson:
        return Lesson(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.labels, other.labels]),
            np.concatenate([self.weights, other.weights]),
            np.concatenate([self.extents, other.extents]),
            np.concatenate([self.fits, other.fits]),
        )

    def seen(self, settings: Settings) -> Lesson:
        """These, or without the histograms of colours: what no row tells of, no model weighs."""
        if not settings.teaching.colours:
            self.rows[:, COLOURS] = self.extents[:, COLOURS] = 0
        return self


def first(frame: Pyramid, box: Box, rng: np.random.Generator, settings: Settings) -> Lesson:
    """What the first frame teaches: n affine copies of the box and n windows around it, a leaf of each tree."""
    count, context, moved = settings.coreset.size, settings.search.context, settings.teaching.other_backgrounds
    copies = affine.copies(frame, box, count, rng, context=context, moved=moved)
    lesson = Lesson.of(list(copies), 1, settings.teaching.object_weight)
    lesson += _around(_unscored(frame, box), box, count, 0, rng, settings)
    return with_extents(lesson.seen(settings), frame, box, settings)


def near(
    frame: Pyramid,
    box: Box,
    model: Model | None,
    rng: np.random.Generator,
    settings: Settings,
    around: Scored | None = None,
) -> Lesson:
    """What a later frame teaches: the object, affine copies of it, near misses and background.

    Parameters
    ----------
    model : half of the background windows are those that score highest with it; None, all are anywhere
    around : cells that hold the object, if a search has left some: near misses and background are taken from these,
        where they are enough
    """
    own = list(affine.copies(frame, box, 1 + settings.teaching.copies, rng, mirrored=settings.teaching.mirrored))
    lesson = Lesson.of(own, 1, settings.teaching.object_weight / len(own))
    count, hardest = settings.teaching.near_negatives, settings.teaching.near_negatives // 2
    if model is None:
        around, hardest = _unscored(frame, box), 0
    elif around is None or min(around.cells.shape) < _CELLS:
        around = search.scored_around(frame, box, _CELLS, model)
    return (lesson + _around(around, box, count, hardest, rng, settings)).seen(settings)


def far(frame: Pyramid, box: Box, model: Model, settings: Settings) -> Lesson:
    """Hard negatives: the windows of the whole frame that look most like the object and are not it."""
    scored = search.scored_whole(frame, box, model)
    places = windows.peaks(scored.scores, settings.teaching.hard_negatives + 1, WINDOW // 2)
    rows = [scored.row(*place) for place in places if scored.box(*place).overlap(box) < 0.2]
    return Lesson.of(rows[: settings.teaching.hard_negatives], 0).seen(settings)


def with_extents(lesson: Lesson, frame: Pyramid, box: Box, settings: Settings) -> Lesson:
    """A lesson, and how large the object is: its first row is the object's own."""
    rows, fits = extent.cuts(frame, box, lesson.rows[0], settings)
    return replace(lesson, extents=_array(rows), fits=np.array(fits, np.float32)).seen(settings)


def _array(rows: list[np.ndarray]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(len(rows), row_length())


def _unscored(frame: Pyramid, box: Box) -> Scored:
    cells, origin, step = windows.around(frame, box, _CELLS)
    return Scored(cells, np.zeros((_CELLS - WINDOW + 1,) * 2, np.float32), origin, step)


def _around(scored: Scored, box: Box, count: int, hardest: int, rng: np.random.Generator, settings: Settings) -> Lesson:
    """Near misses of a box, and `count` background windows: the `hardest` highest scoring ones, the rest anywhere."""
    row, column = scored.place(box)
    rows, columns = scored.scores.shape
    down, across = np.arange(rows)[:, None] - row, np.arange(columns) - column
    outside = np.maximum(abs(down), abs(across)) > _NEAR + 0.5
    misses, labels = [], []
    near = np.argwhere(~outside)
    for place in near[rng.integers(len(near), size=settings.teaching.near_misses)] if len(near) else ():
        distance = math.hypot(down[place[0], 0], across[place[1]])
        if distance > _NEAREST:
            misses.append(scored.row(*place))
            labels.append(math.exp(-((distance / settings.teaching.near_sigma) ** 2) / 2))
    places = windows.peaks(np.where(outside, scored.scores, -np.inf), hardest, _NEAR)
    anywhere = np.argwhere(outside)
    places += list(map(tuple, rng.choice(anywhere, count - len(places), replace=count > len(anywhere))))
    return Lesson.of(misses, labels) + Lesson.of([scored.row(*place) for place in places], 0)
