"""Balance: a box that crept off the object is drawn after the object's colours.

Each model learns from the boxes that the one before found. A fraction of a pixel that they lie beside
the object is learned with it, and the next boxes lie a little further. The colours do not creep: their
centre of mass lies at one place in a good box, about its middle. The first frames, whose box was given,
say at which; a box that leaves it behind is moved until it lies there again.
"""

from __future__ import annotations

import numpy as np

from catstream.box import Box
from catstream.detection.windows import Scored
from catstream.features.colours import SIDE
from catstream.features.hog import WINDOW

__all__ = ["Balance"]

_FIRST = 40  # frames that say where the mass lies in a good box
_RATE = 0.1  # share that a frame has in where it lies now
_CONTRAST = 0.4  # share of the window's mass that is above the background's: with less, its centre says little
_MARGIN = 2 * SIDE  # shades around the window, whose mass is the background's
_INSIDE = slice(_MARGIN, -_MARGIN)
#: Where each shade lies from the window's middle, in windows.
_PLACES = (np.arange(WINDOW * SIDE + 2 * _MARGIN) - _MARGIN + 0.5) / (WINDOW * SIDE) - 0.5


class Balance:
    """Where in its window an object's colours have their centre of mass: in the first frames, and now.

    Attributes
    ----------
    state : float64 (6,): frames taken in, the usual contrast, the first centre's x and y, and the present one's, both
        from the window's middle, in windows
    """

    def __init__(self) -> None:
        self.state = np.zeros(6)

    @classmethod
    def resumed(cls, state: np.ndarray) -> Balance:
        """One that goes on from another one's state, bit for bit."""
        self = cls()
        self.state[:] = state
        self.state[0] = max(0.0, self.state[0])  # it came over the wire
        return self

    def drawn(self, box: Box, around: Scored, weights: np.ndarray, slack: float) -> Box:
        """Take in a frame: the box, or one moved after the mass.

        Parameters
        ----------
        box : the window that was found
        around : cells that hold it
        weights : float32 (SHADES,), the model's, of the histogram of colours
        slack : windows that the centre may lie beyond its first place, or beyond the middle, before the box follows
        """
        mass = _above_background(around, box, weights)
        if mass is None:
            return box
        contrast, *centre = mass
        self.state[0] = frames = min(self.state[0] + 1, _FIRST + 1)
        self.state[1] += (contrast - self.state[1]) * max(_RATE, 1 / frames)
        first, now = self.state[2:4], self.state[4:]
        if frames <= _FIRST:
            first += (centre - first) / frames
            now[:] = first
            return box
        now += _RATE * (centre - now)
        if self.state[1] < _CONTRAST:
            return box
        beyond = now - np.clip(now, np.minimum(first, 0) - slack, np.maximum(first, 0) + slack)
        x, y = box.centre
        return box.centred(x + float(beyond[0]) * box.w, y + float(beyond[1]) * box.h)


def _above_background(around: Scored, box: Box, weights: np.ndarray) -> tuple[float, float, float] | None:
    """The share of a window's mass above the background's, and its centre; None where it has none, or cells lack.

    A shade's mass is what it speaks for the object.
    """
    row, column = around.place(box)
    top, left = round(row * SIDE) - _MARGIN, round(column * SIDE) - _MARGIN
    shades = around.cells.shades[max(top, 0) : top + len(_PLACES), max(left, 0) : left + len(_PLACES)]
    if shades.shape != (len(_PLACES),) * 2:
        return None
    mass = np.maximum(weights, 0)[shades]
    inner = mass[_INSIDE, _INSIDE]
    background = (mass.sum() - inner.sum()) / (mass.size - inner.size)
    above = np.maximum(mass - background, 0)
    total = above.sum()
    if inner.mean() <= background or not total:  # rounding alone can make an even mass look uneven
        return None
    across, down = above.sum(axis=0) @ _PLACES / total, above.sum(axis=1) @ _PLACES / total
    return float(1 - background / inner.mean()), float(across), float(down)
