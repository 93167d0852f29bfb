"""Extent: the size and the aspect ratio (width to height) of the object.

The appearance model alone prefers windows that are too small: they hold less background. The extent head learns how
well a window fits, from windows of the object that fit and windows that are too large, too small, too wide or too high.
"""

from __future__ import annotations

import math

from catstream.box import Window
from catstream.settings import ExtentSettings

__all__ = ["cost", "followed", "size", "stretch", "trials"]

_GROWTH = 1.18  # factor of size that no object grows by in a frame


def followed(before: Window, window: Window, resize: bool, settings: ExtentSettings) -> Window:
    """The window of a detection, its size and aspect ratio smoothed; they stay as before unless `resize`.

    A size change beyond a factor of 1.18 is a detection of the object elsewhere: the window is taken as it is.
    """
    growth = math.sqrt(window.area / before.area)
    if not 1 / _GROWTH < growth < _GROWTH:
        return window
    if not resize:
        return before.centred(*window.centre)
    grown = growth**settings.size_rate
    stretched = math.sqrt(window.w / window.h * before.h / before.w) ** settings.aspect_rate
    return before.scaled(grown * stretched, grown / stretched).centred(*window.centre)


def trials(window: Window, settings: ExtentSettings) -> list[tuple[int, Window]]:
    """Windows of wrong sizes and of wrong aspect ratios, with the steps that each is off; none if `weight` is 0."""
    if not settings.weight:
        return []
    sizes = [(k, window.scaled(size(k, settings))) for k in _steps(settings.size_count)]
    return sizes + [(k, window.scaled(*stretch(k, settings))) for k in _steps(settings.aspect_count)]


def cost(change: float, now: float, settings: ExtentSettings) -> float:
    """Cost of the change of a logarithm that differs from that of the first window by `now` already."""
    return settings.penalty * abs(change) + settings.prior * (change + now) ** 2


def _steps(count: int) -> list[int]:
    """Steps to try, smallest or narrowest first, without 0."""
    return [k for k in range(-(count // 2), count // 2 + 1) if k]


def size(step: float, settings: ExtentSettings) -> float:
    """Factor of both sides."""
    return float((1 + settings.size_step) ** step)


def stretch(step: float, settings: ExtentSettings) -> tuple[float, float]:
    """Factors of width and height that change the aspect ratio and keep the area."""
    root = (1 + settings.aspect_step) ** (step / 2)
    return root, 1 / root
