"""Extent: the size and the aspect ratio (width to height) of the object.

The appearance model alone prefers windows that are too small: they contain less background. The extent head learns how
well a window fits, from windows of the object that fit and windows that are too large, too small, too wide or too high.
From the same windows, the size head and the aspect head learn how many steps a window is too large or too wide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from catstream.base.box import Window
from catstream.base.settings import ExtentSettings

_SIZE_STEP, _ASPECT_STEP = 0.04, 0.08  # relative change from one size or aspect ratio to the next
#: The same changes as differences of logarithms.
SIZE_CHANGE, ASPECT_CHANGE = math.log(1 + _SIZE_STEP), math.log(1 + _ASPECT_STEP)

#: Number of wider and of narrower aspect ratios that a search may try; few, because a fifth of a change is applied.
ASPECT_STEPS = 2
_PRIOR = 0.5  # weight of (log f)^2, for a size or an aspect ratio of f times the first one; 0.3 tracks worse

_SIZE_RATE, _ASPECT_RATE = 0.7, 0.2  # share of a logarithmic change that is applied in one frame
_PENALTY = 0.3  # weight of |log f|, for a change by the factor f
_LABEL_STEPS = 16  # steps between the labels 0 and 1 of the size and the aspect head
_OFFSET_WEIGHT = 0.02  # weight of the squared error of a window, in steps
_LARGE_OFFSET = 1.0  # steps above which this cost grows linearly
_MAX_GROWTH = 1.18  # larger than the growth of any object in a frame


class Trial(NamedTuple):
    """A window of a wrong extent, with the steps by which it is too large and too wide."""

    window: Window
    larger: int = 0
    wider: int = 0


def smooth(before: Window, window: Window, *, resize: bool) -> Window:
    """Smooth the size and the aspect ratio of a detection's window; they stay as before unless `resize`.

    A window whose size changes by more than a factor of 1.18 shows the object elsewhere, and is returned unchanged.
    """
    growth = math.sqrt(window.area / before.area)
    if not 1 / _MAX_GROWTH < growth < _MAX_GROWTH:
        return window
    if not resize:
        return before.centred(*window.centre)
    size_factor = growth**_SIZE_RATE
    aspect_factor = math.sqrt(window.w / window.h * before.h / before.w) ** _ASPECT_RATE
    return before.scaled(size_factor * aspect_factor, size_factor / aspect_factor).centred(*window.centre)


def trials(window: Window, settings: ExtentSettings) -> list[list[Trial]]:
    """Windows of wrong sizes, then of wrong aspect ratios, over the searched ranges; empty unless they are learned."""
    if not settings.learned:
        return []
    sizes = [Trial(window.scaled(size(k)), larger=k) for k in _steps(settings.size_count // 2)]
    aspects = [Trial(window.scaled(*stretch(k)), wider=k) for k in _steps(ASPECT_STEPS)]
    return [kind for kind in (sizes, aspects) if kind]


def offset_label(steps: int) -> float:
    """Label of a window that is a number of steps too large or too wide, from 0 to 1.

    >>> offset_label(0), offset_label(4)
    (0.5, 0.75)
    """
    return 0.5 + steps / _LABEL_STEPS


def offset_cost(row: np.ndarray, head: np.ndarray, bias: float) -> float:
    """Huber loss of the steps by which a window is too large or too wide, as the size or the aspect head predicts.

    The loss is robust, because the prediction for a new appearance may be wrong by many steps. The features of the
    window and the head are float32 (d,).
    """
    error = abs(float(row @ head) + bias - 0.5) * _LABEL_STEPS
    return _OFFSET_WEIGHT * (error**2 if error < _LARGE_OFFSET else _LARGE_OFFSET * (2 * error - _LARGE_OFFSET))


def cost(change: float, deviation: float = 0.0, prior: float = 0.0) -> float:
    """Cost of a change of log f, which already deviates by `deviation` from the first window."""
    return _PENALTY * abs(change) + prior * (change + deviation) ** 2


def prior(settings: ExtentSettings) -> float:
    """Weight of the squared logarithm of the size, or the aspect ratio, relative to the first window."""
    return _PRIOR if settings.learned else 0.0


def _steps(limit: int) -> list[int]:
    """The steps of sizes or aspect ratios up to `limit` in both directions, smallest or narrowest first, without 0."""
    return [k for k in range(-limit, limit + 1) if k]


def size(step: float) -> float:
    """Factor of width and height that changes the size by a number of steps."""
    return float((1 + _SIZE_STEP) ** step)


def stretch(step: float) -> tuple[float, float]:
    """Factors of width and height that change the aspect ratio by a number of steps, at the same area."""
    root = (1 + _ASPECT_STEP) ** (step / 2)
    return root, 1 / root
