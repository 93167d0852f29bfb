"""Search: where in a frame the model scores highest.

Near the place where the object is expected, or in the whole frame. A search at
another size resizes the frame, not the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from catstream.box import Box
from catstream.detection import windows
from catstream.detection.windows import Scored
from catstream.features.hog import CELL, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.messages import Model
from catstream.settings import Settings

__all__ = ["Found", "highest", "local", "scored_around", "scored_whole", "sought", "whole"]

_FAR_FACTORS = (1.0, 0.8, 1.25)  # of the object's size, at which a whole frame is searched
_MOST_PIXELS = 4_000_000  # of a resized frame: what a whole search may cost for a tiny object in a large frame


@dataclass(frozen=True, slots=True)
class Found:
    """A window and its score.

    around : what a local search scored, which the window is in; None where there was none
    """

    score: float
    box: Box
    around: Scored | None = None


def local(frame: Pyramid, box: Box, model: Model, settings: Settings) -> Found:
    """The best window near a box, of its size.

    Distance costs a little of the score, so that of two equal windows the nearer wins.
    """
    cells = WINDOW + 2 * round((settings.search.area - 1) * WINDOW / 2)
    scored = scored_around(frame, box, cells, model)
    away = (np.arange(cells - WINDOW + 1) - (cells - WINDOW) // 2) / WINDOW
    place = highest(scored.scores - settings.search.distance_penalty * (away[:, None] ** 2 + away**2))
    return Found(float(scored.scores[place]), scored.box(*scored.refined(*place)), scored)


def whole(frame: Pyramid, box: Box, model: Model, settings: Settings) -> Found:
    """The best window of a whole frame, at three sizes: that of a box, and a quarter less and more."""
    best, least = Found(-np.inf, box), -np.inf
    for factor in _FAR_FACTORS:
        scored = scored_whole(frame, box.scaled(factor), model)
        place = highest(scored.scores)
        score = float(scored.scores[place])
        worth = score - settings.extent.penalty * abs(np.log(factor))
        if worth > least:
            least = worth
            best = Found(score, scored.box(*scored.refined(*place)))
    return best


def sought(
    frame: Pyramid, box: Box, factors: tuple[float, ...], model: Model, settings: Settings
) -> tuple[Found, float]:
    """The best window of a whole frame at several sizes, and by how much it scores higher than the rest of the frame.

    In a scene that the model never saw, anything may score high. The windows that do not touch the best
    one show how high; 0, the mean of the background that was learned, counts as one of them.

    Parameters
    ----------
    factors : the sizes, as factors of that of the box
    """
    sizes = [scored_whole(frame, box.scaled(factor), model) for factor in factors]
    costs = [settings.extent.penalty * abs(np.log(factor)) for factor in factors]
    worths = [float(scored.scores.max()) - cost for scored, cost in zip(sizes, costs, strict=True)]
    best = sizes[int(np.argmax(worths))]
    place = highest(best.scores)
    found = Found(float(best.scores[place]), best.box(*best.refined(*place)))
    return found, found.score - max(0.0, *(_highest_apart(scored, found.box) for scored in sizes))


def _highest_apart(scored: Scored, box: Box) -> float:
    """The highest score of a window that does not touch a box; -inf if there is none."""
    (x, y), (w, h) = scored.origin, scored.step
    rows, columns = scored.scores.shape
    top, left = y + h * np.arange(rows), x + w * np.arange(columns)
    beyond = (top >= box.y + box.h) | (top + WINDOW * h <= box.y)
    beside = (left >= box.x + box.w) | (left + WINDOW * w <= box.x)
    return float(scored.scores.max(where=beyond[:, None] | beside, initial=-np.inf))


def scored_around(frame: Pyramid, box: Box, side: int, model: Model) -> Scored:
    """Scores of all windows in `side` x `side` cells around a box."""
    cells, origin, step = windows.around(frame, box, side)
    return Scored(cells, cells.respond(model.weights, model.bias), origin, step)


def scored_whole(frame: Pyramid, box: Box, model: Model) -> Scored:
    """Scores of all windows of the size of a box in a frame.

    Where the frame, resized so that the box is a window, would be too large to search in time,
    it is the part around the box.
    """
    width, height = frame.size
    window = WINDOW * CELL
    reach = np.sqrt(_MOST_PIXELS / (width * window / box.w * height * window / box.h))
    left, top = 0, 0
    if reach < 1:
        x, y = box.centre
        w, h = int(width * reach), int(height * reach)
        left, top = int(np.clip(x - w / 2, 0, width - w)), int(np.clip(y - h / 2, 0, height - h))
        frame = Pyramid(frame.image[top : top + h, left : left + w])
    cells, origin, step = windows.whole(frame, box)
    origin = origin[0] + left, origin[1] + top
    return Scored(cells, cells.respond(model.weights, model.bias), origin, step)


def highest(scores: np.ndarray) -> tuple[int, int]:
    """Row and column of the highest window."""
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    return int(row), int(column)
