"""Extent: how large the object is, and how wide for its height, at a place that a search found.

The appearance model alone likes windows that are too small: they hold less background. A second
one learns how well a window fits from the object cut as it is, and cut badly.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from catstream.box import Box
from catstream.detection import search, windows
from catstream.detection.search import Found
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.heads import EXTENT
from catstream.messages import Model
from catstream.settings import Settings

__all__ = ["cuts", "fitted", "followed"]

_FINE_CELLS = WINDOW + 2  # cells searched at each size: the place found at another size may be a cell off
_GROWTH = 1.18  # factor of size that no object grows by in a frame


def fitted(frame: Pyramid, box: Box, first: Box, model: Model, settings: Settings) -> Found:
    """The best window within a cell of a box, at the size and the aspect that both models like best together.

    Parameters
    ----------
    first : the window of the first frame, whose extent is likelier than others
    """
    now, fits = math.log(box.area / first.area) / 2, model.heads.get(EXTENT)
    found: dict[int, Found] = {}

    def value(step: int) -> float:
        scored = search.scored_around(frame, box.scaled(_size(step, settings)), _FINE_CELLS, model)
        place = search.highest(scored.scores)
        score = float(scored.scores[place])
        found[step] = Found(score, scored.box(*scored.refined(*place)))
        fit = 0.0 if fits is None else settings.extent.weight * float(scored.row(1, 1) @ fits)
        return score + fit - _cost(step * math.log(1 + settings.extent.size_step), now, settings)

    step, beside = _climbed(value, settings.extent.size_count // 2)
    best = Found(found[step].score, found[step].box.scaled(_size(beside, settings)))
    return best if fits is None else _widened(frame, best, first, model, settings)


def _widened(frame: Pyramid, found: Found, first: Box, model: Model, settings: Settings) -> Found:
    """The same place, size and score, at the best aspect."""
    now = math.log(found.box.w / found.box.h * first.h / first.w)

    def value(step: int) -> float:
        scored = search.scored_around(frame, found.box.scaled(*_stretch(step, settings)), WINDOW, model)
        fit = settings.extent.weight * float(scored.row(0, 0) @ model.heads[EXTENT])
        return float(scored.scores[0, 0]) + fit - _cost(step * math.log(1 + settings.extent.aspect_step), now, settings)

    step, beside = _climbed(value, settings.extent.aspect_count // 2)
    return Found(found.score, found.box.scaled(*_stretch(step + beside, settings)))


def _climbed(value: Callable[[int], float], most: int) -> tuple[int, float]:
    """The best step: from 0 up or down for as long as the value rises, at most so far either way.

    Returns
    -------
    the step, and how far beside it the top of the parabola through its neighbours lies
    """
    values = {step: value(step) for step in range(-min(most, 1), min(most, 1) + 1)}
    best = way = max(values, key=values.__getitem__)
    while way and abs(best) < most:
        values[best + way] = value(best + way)
        if values[best + way] <= values[best]:
            break
        best += way
    around = np.array([values.get(step, -np.inf) for step in (best - 1, best, best + 1)])
    return best, windows.vertex(around, 1) if np.isfinite(around).all() else 0.0


def followed(before: Box, found: Found, settings: Settings) -> Box:
    """The box found, its size and aspect following slowly, and not at all where the score is low.

    A far larger change is no growth of the object, but another place: it is taken over whole.
    """
    growth = math.sqrt(found.box.area / before.area)
    if not 1 / _GROWTH < growth < _GROWTH:
        return found.box
    if found.score < settings.belief.extent_score:
        return before.centred(*found.box.centre)
    size = growth**settings.extent.size_rate
    stretch = math.sqrt(found.box.w / found.box.h * before.h / before.w) ** settings.extent.aspect_rate
    return before.scaled(size * stretch, size / stretch).centred(*found.box.centre)


def cuts(frame: Pyramid, box: Box, own: np.ndarray, settings: Settings) -> tuple[list[np.ndarray], list[float]]:
    """The object cut as it is and badly, and how well each cut fits; nothing where extent is not learned.

    Parameters
    ----------
    own : feature row of the object's own box, float32 (d,)

    Returns
    -------
    feature rows, and 1 for a cut as it is, exp(-k^2 / 2 sigma^2) for one k steps off
    """
    if not settings.extent.weight:
        return [], []
    trials = [(k, box.scaled(_size(k, settings))) for k in _steps(settings.extent.size_count) if k]
    trials += [(k, box.scaled(*_stretch(k, settings))) for k in _steps(settings.extent.aspect_count) if k]
    rows = [windows.around(frame, trial, WINDOW)[0].row(0, 0) for _, trial in trials]
    fits = [math.exp(-((k / settings.extent.sigma) ** 2) / 2) for k, _ in trials]
    return [own, *rows], [1.0, *fits]


def _cost(change: float, now: float, settings: Settings) -> float:
    """What a change of a logarithm costs, where it is off by `now` already."""
    return settings.extent.penalty * abs(change) + settings.extent.prior * (change + now) ** 2


def _steps(count: int) -> range:
    """Steps to try, smallest or narrowest first, 0 in the middle."""
    return range(-(count // 2), count // 2 + 1)


def _size(step: float, settings: Settings) -> float:
    """Factor of both sides."""
    return (1 + settings.extent.size_step) ** step


def _stretch(step: float, settings: Settings) -> tuple[float, float]:
    """Factors of width and height: of another aspect, and the same area."""
    root = (1 + settings.extent.aspect_step) ** (step / 2)
    return root, 1 / root
