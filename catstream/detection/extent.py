"""Extent: the size and the aspect ratio (width to height) of the object.

The appearance model alone prefers windows that are too small: they hold less background. The extent head learns how
well a window fits, from windows of the object that fit and windows that are too large, too small, too wide or too high.
The size head and the aspect head learn from the same windows by how many steps a window is too large or too wide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from catstream.base.box import Window
from catstream.base.settings import ExtentSettings

_SIZE_STEP, _ASPECT_STEP = 0.04, 0.08  # relative change from one size or aspect ratio that is tried to the next
#: Change of the logarithm by a step.
SIZE_CHANGE, ASPECT_CHANGE = math.log(1 + _SIZE_STEP), math.log(1 + _ASPECT_STEP)

_SIZE_RATE, _ASPECT_RATE = 0.7, 0.2  # share of a change that is applied in one frame, of its logarithm
_PENALTY = 0.3  # weight of |log f|, for a change by the factor f
_LABEL_STEPS = 16  # steps between the labels 0 and 1 of the size and the aspect head
_OFFSET_WEIGHT = 0.02  # weight of the squared steps that a window is off
_LARGE_OFFSET = 1.0  # steps from which this cost grows linearly
_GROWTH = 1.18  # factor of size that no object grows by in a frame


class Trial(NamedTuple):
    """A window, and the steps by which it is too large and too wide."""

    window: Window
    larger: int = 0
    wider: int = 0


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


def trials(window: Window, settings: ExtentSettings) -> list[list[Trial]]:
    """Windows of wrong sizes, then windows of wrong aspect ratios.

    Those that are not searched are left out, and both are if `weight` is 0.
    """
    if not settings.weight:
        return []
    sizes = [Trial(window.scaled(size(k)), larger=k) for k in _steps(settings.size_count)]
    aspects = [Trial(window.scaled(*stretch(k)), wider=k) for k in _steps(settings.aspect_count)]
    return [each for each in (sizes, aspects) if each]


def offset_label(steps: int) -> float:
    """Label of a window that is a number of steps too large or too wide, from 0 to 1.

    >>> offset_label(0), offset_label(4)
    (0.5, 0.75)
    """
    return 0.5 + steps / _LABEL_STEPS


def offset_cost(row: np.ndarray, head: np.ndarray, bias: float) -> float:
    """Cost of the steps by which a window is too large or too wide as the size or the aspect head predicts it.

    It is Huber's function, because the prediction for an object that looks new may be wrong by many steps. The features
    of the window and the head are float32 (d,).
    """
    off = abs(float(row @ head) + bias - 0.5) * _LABEL_STEPS
    return _OFFSET_WEIGHT * (off**2 if off < _LARGE_OFFSET else _LARGE_OFFSET * (2 * off - _LARGE_OFFSET))


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
