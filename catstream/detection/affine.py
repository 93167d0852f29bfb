"""Affine copies: a box slightly scaled, shifted and rotated, as one row each.

They are the training samples that the first frame can give (paper, "System
Implementation"): n of them make the first leaf at once. The corners of a box are
not the object, but all copies of one frame agree on them: some are put on another
background. And what turns round shows its other side, which often is the mirrored one.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from catstream.box import Box
from catstream.features.cells import Cells
from catstream.features.hog import CELL, MARGIN, WINDOW
from catstream.features.pyramid import Pyramid

__all__ = ["copies"]

_SCALE, _SHIFT, _TURN = 0.03, 0.02, 0.05  # standard deviations: a factor, a share of the box, radians
_SIDE = (WINDOW + 2 * MARGIN) * CELL  # of a copy with its margin, in pixels
_NEAREST, _FARTHEST = 0.3, 1.0  # how far away another background is, in boxes
_SOLID, _GONE = 0.8, 1.15  # where the object's ellipse begins to fade, and has; 1 touches the sides of its box


def copies(
    frame: Pyramid,
    box: Box,
    count: int,
    rng: np.random.Generator,
    *,
    context: float = 1.0,
    moved: float = 0.0,
    mirrored: int = 0,
) -> np.ndarray:
    """Features of `count` copies of a box; the first is the box itself.

    Parameters
    ----------
    box : in pixels of the frame
    rng : where scale, shift and rotation come from
    context : size of the box as a multiple of the object's
    moved : share of them that are put on another background of the frame
    mirrored : how many of them, the last ones, are turned left to right

    Returns
    -------
    float32 (count, d)
    """
    change = rng.normal(size=(count, 4))
    if count:
        change[0] = 0
    rows = []
    x, y = box.centre
    for number, (scale, right, down, turn) in enumerate(change):
        factor = np.exp(_SCALE * scale) / (WINDOW * CELL)
        pixel = box.w * factor, box.h * factor
        centre = x + _SHIFT * right * box.w, y + _SHIFT * down * box.h
        patch = frame.cut(*centre, *pixel, _SIDE, _TURN * turn)
        if number and number * moved % 1 < moved:
            angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(_NEAREST, _FARTHEST)
            away = centre[0] + far * np.cos(angle) * box.w, centre[1] + far * np.sin(angle) * box.h
            patch = _put_on(frame.cut(*away, *pixel, _SIDE, _TURN * turn), patch, context)
        if number >= max(count - mirrored, 1):
            patch = cv2.flip(patch, 1)
        rows.append(Cells.within(patch).row(0, 0))
    return np.array(rows, np.float32)


def _put_on(background: np.ndarray, patch: np.ndarray, context: float) -> np.ndarray:
    """The ellipse in the middle of a patch, its edge blurred, on a background of the same size."""
    share = _ellipse(context)
    return cv2.blendLinear(patch, background, share, 1 - share)


@cache
def _ellipse(context: float) -> np.ndarray:
    """Share of the object in each pixel of a copy, float32: 1 inside its ellipse, falling to 0 around it."""
    across = (np.arange(_SIDE) - (_SIDE - 1) / 2) / (WINDOW * CELL / context / 2)
    out = np.hypot(across[:, None], across)
    return ((_GONE - out) / (_GONE - _SOLID)).clip(0, 1).astype(np.float32)
