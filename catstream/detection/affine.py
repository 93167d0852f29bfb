"""Affine copies: a box slightly scaled, shifted and rotated, as one row each.

They are the training samples that the first frame can give (paper, "System
Implementation"): n of them make the first leaf at once.
"""

from __future__ import annotations

import numpy as np

from catstream.box import Box
from catstream.detection.hog import CELL, MARGIN, WINDOW, grid
from catstream.detection.pyramid import Pyramid
from catstream.detection.windows import cut

__all__ = ["copies"]

_SCALE, _SHIFT, _TURN = 0.03, 0.02, 0.05  # standard deviations: a factor, a share of the box, radians


def copies(frame: Pyramid, box: Box, count: int, rng: np.random.Generator) -> np.ndarray:
    """Features of `count` copies of a box; the first is the box itself.

    Parameters
    ----------
    box : in pixels of the frame
    rng : where scale, shift and rotation come from

    Returns
    -------
    float32 (count, d)
    """
    change = rng.normal(size=(count, 4))
    if count:
        change[0] = 0
    rows = []
    (x, y), size = box.centre, (WINDOW + 2 * MARGIN) * CELL
    for scale, right, down, turn in change:
        factor = np.exp(_SCALE * scale) / (WINDOW * CELL)
        centre = x + _SHIFT * right * box.w, y + _SHIFT * down * box.h
        patch = cut(frame, *centre, box.w * factor, box.h * factor, size, _TURN * turn)
        rows.append(grid(patch)[MARGIN:-MARGIN, MARGIN:-MARGIN].reshape(-1))
    return np.array(rows, np.float32)
