"""Colour centroid: shifts a window that has drifted off the object back to where the object's colours are.

Each model learns from the windows that the one before found. A fraction of a pixel that they lie beside the object is
learned with it, and the next windows lie a little further off. The colours do not drift: their centroid lies in one
place of a good window, near its middle. The first frames, whose box was given, show in which; a window that leaves it
is shifted until it lies there again.

What is remembered is a float64 (6,): frames taken in, the mean contrast, then the first and the present centroid (x, y
each, from the middle of the window, in windows).
"""

from __future__ import annotations

import numpy as np

from catstream.box import Window
from catstream.features.layout import SIDE, WINDOW
from catstream.features.score_map import ScoreMap

__all__ = ["recentred"]

_FIRST = 40  # frames whose mean is the first centroid
_RATE = 0.1  # weight of a frame in the running mean of the present centroid
_CONTRAST = 0.4  # share of the mass in the window above the background's; with less, the centroid means little
_MARGIN = 2 * SIDE  # shades around the window, whose mass is the background's
_INSIDE = slice(_MARGIN, -_MARGIN)
#: Offset of each shade from the middle of the window, in windows.
_PLACES = (np.arange(WINDOW * SIDE + 2 * _MARGIN) - _MARGIN + 0.5) / (WINDOW * SIDE) - 0.5


def recentred(
    known: np.ndarray | None, window: Window, around: ScoreMap, weights: np.ndarray, slack: float
) -> tuple[np.ndarray | None, Window]:
    """Update the running centroid; shift the window if the centroid has drifted by more than the slack.

    Parameters
    ----------
    known : the state of the earlier frames, as above; None before the first
    window : of the detection
    around : features that hold it
    weights : float32 (SHADES,), of the histogram of colours in the model
    slack : windows by which the centroid may lie beyond its first place, or beyond the middle
    """
    mass = _above_background(around, window, weights)
    if mass is None:
        return known, window
    contrast, *centroid = mass
    known = np.zeros(6) if known is None else known
    frames = min(max(known[0], 0.0) + 1, _FIRST + 1)
    mean_contrast = known[1] + (contrast - known[1]) * max(_RATE, 1 / frames)
    first, now = known[2:4], known[4:]
    if frames <= _FIRST:
        first = now = first + (centroid - first) / frames
    else:
        now = now + _RATE * (centroid - now)
    learned = np.concatenate([[frames, mean_contrast], first, now])
    if frames <= _FIRST or mean_contrast < _CONTRAST:
        return learned, window
    beyond = now - np.clip(now, np.minimum(first, 0) - slack, np.maximum(first, 0) + slack)
    x, y = window.centre
    return learned, window.centred(x + float(beyond[0]) * window.w, y + float(beyond[1]) * window.h)


def _above_background(around: ScoreMap, window: Window, weights: np.ndarray) -> tuple[float, float, float] | None:
    """The contrast of the mass in a window and its centroid; None if it has none, or if cells around it are missing.

    The mass of a shade is the positive part of its weight in the model. What it is above the mean mass around the
    window counts.
    """
    row, column = around.place(window)
    top, left = round(row * SIDE) - _MARGIN, round(column * SIDE) - _MARGIN
    shades = around.cells.shades[max(top, 0) : top + len(_PLACES), max(left, 0) : left + len(_PLACES)]
    if shades.shape != (len(_PLACES),) * 2:
        return None
    mass = np.maximum(weights, 0)[shades]
    inner = mass[_INSIDE, _INSIDE]
    within = inner.sum()
    background, inside = (mass.sum() - within) / (mass.size - inner.size), within / inner.size
    above = np.maximum(mass - background, 0)
    total = above.sum()
    if inside <= background or not total:  # rounding alone can make an even mass look uneven
        return None
    across, down = above.sum(axis=0) @ _PLACES / total, above.sum(axis=1) @ _PLACES / total
    return float(1 - background / inside), float(across), float(down)
