"""Extent: the size and the aspect ratio (width to height) of the object.

The appearance model alone prefers windows that are too small: they hold less background. The extent head learns how
well a window fits, from windows of the object that fit and windows that are too large, too small, too wide or too high.
"""

from __future__ import annotations

import math

from catstream.box import Window
from catstream.settings import ExtentSettings

__all__ = ["ASPECT_CHANGE", "SIZE_CHANGE", "cost", "followed", "size", "stretch", "trials"]

_SIZE_STEP, _ASPECT_STEP = 0.04, 0.08  # relative change from one size or aspect ratio that is tried to the next
#: Change of the logarithm by a step.
SIZE_CHANGE, ASPECT_CHANGE = math.log(1 + _SIZE_STEP), math.log(1 + _ASPECT_STEP)

_SIZE_RATE, _ASPECT_RATE = 0.7, 0.2  # share of a change that is applied in one frame, of its logarithm
_PENALTY = 0.3  # weight of |log f|, for a change by the factor f
_GROWTH = 1.18  # factor of size that no object grows by in a frame


def followed(before: Window, window: Window, resize: bool) -> Window:
    """The window of a detection, its size and aspect ratio smoothed; they stay as before unless `resize`.

    A size change beyond a factor of 1.18 is a detection of the object elsewhere: the window is taken as it is.
    """
    growth = math.sqrt(window.area / before.area)
    if not 1 / _GROWTH < growth < _GROWTH:
        return window
    if not resize:
        return before.centred(*window.centre)
    grown = growth**_SIZE_RATE
    stretched = math.sqrt(window.w / window.h * before.h / before.w) ** _ASPECT_RATE
    return before.scaled(grown * stretched, grown / stretched).centred(*window.centre)


def trials(window: Window, settings: ExtentSettings) -> list[tuple[int, Window]]:
    """Windows of wrong sizes and of wrong aspect ratios, with the steps that each is off; none if `weight` is 0."""
    if not settings.weight:
        return []
    sizes = [(k, window.scaled(size(k))) for k in _steps(settings.size_count)]
    return sizes + [(k, window.scaled(*stretch(k))) for k in _steps(settings.aspect_count)]


def cost(change: float, now: float = 0.0, prior: float = 0.0) -> float:
    """Cost of the change of a logarithm that differs from that of the first window by `now` already."""
    return _PENALTY * abs(change) + prior * (change + now) ** 2


def _steps(count: int) -> list[int]:
    """Steps to try, smallest or narrowest first, without 0."""
    return [k for k in range(-(count // 2), count // 2 + 1) if k]


def size(step: float) -> float:
    """Factor of both sides."""
    return float((1 + _SIZE_STEP) ** step)


def stretch(step: float) -> tuple[float, float]:
    """Factors of width and height that change the aspect ratio and keep the area."""
    root = (1 + _ASPECT_STEP) ** (step / 2)
    return root, 1 / root
