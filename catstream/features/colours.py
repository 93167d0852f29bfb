"""Colours: how much of each the middle of a window holds, wherever in it that is.

HOG and the mean colour of a cell say what is where. An object that bends or turns moves both
between the cells, but keeps its colours: 288 shades of Lab, 8 of lightness by 6 x 6 of a and b.
A window's histogram counts them in its middle 6 x 6 cells, which are mostly object; the square
root of each share is a feature, so that distances are Hellinger's.

Four pixels are averaged to one first: a cell has 4 x 4 shades.
"""

from __future__ import annotations

import cv2
import numpy as np

from catstream.arrays import Float32, Int64, UInt8, UInt16
from catstream.features.compiled import kernel
from catstream.features.layout import CHROMA, LIGHT, SHADES, SIDE, WINDOW

__all__ = ["add_scores", "highest_score", "histogram", "shades"]

_CHROMA_STEP = 10  # Lab units from one level of a or b to the next
_WEIGHT = 3.0  # length of a histogram as features; that of a window's HOG is about 9
_EDGE = SIDE  # shades of a window's first cell, which is not counted
_COUNTED = WINDOW * SIDE - 2 * _EDGE  # shades along a side of the middle
_LOWEST = float(np.finfo(np.float32).min)  # the kernels do not compute with infinity


def shades(image: np.ndarray) -> np.ndarray:
    """The shade of every 2 x 2 pixels.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR; h and w are even

    Returns
    -------
    uint16 (h // 2, w // 2), below `SHADES`

    >>> len(set(shades(np.array([[0, 0, 90, 90], [0, 0, 90, 90]], np.uint8)[:, :, None].repeat(3, axis=2)).ravel()))
    2
    """
    found = np.empty((image.shape[0] // 2, image.shape[1] // 2), np.uint16)
    _look_up(image, _TABLE, found)
    return found


def histogram(found: np.ndarray, row: int, column: int, features: np.ndarray) -> None:
    """Features of the window whose first cell is (row, column), into float32 (SHADES,)."""
    _histogram(found, row * SIDE + _EDGE, column * SIDE + _EDGE, _ROOTS, np.empty(SHADES, np.int64), features)


def add_scores(found: np.ndarray, weights: np.ndarray, scores: np.ndarray, least: float = _LOWEST) -> None:
    """Add the score of the histogram of each window, in constant time a window.

    Parameters
    ----------
    found : uint16, as `shades` gives them
    weights : float32 (SHADES,)
    scores : float32 (rows - 7, columns - 7), of the window whose first cell is there
    least : windows with a lower score are left out, and their score stays as it is
    """
    # Weights that came over the wire cannot be written, and a kernel takes none of those.
    _add_scores(found, np.require(weights, requirements="W"), _STEPS, least, np.empty(SHADES, np.int64), scores)


def highest_score(weights: np.ndarray) -> float:
    """The highest score that the histogram of any window can have.

    A histogram has no negative features and a constant length, so this is the length times that of the positive weights
    (Cauchy-Schwarz).
    """
    return _WEIGHT * float(np.linalg.norm(np.maximum(weights, 0)))


def _table() -> np.ndarray:
    """Shade of every BGR colour of 5 bits each, blue first."""
    levels = np.arange(4, 256, 8, dtype=np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1)
    lab = cv2.cvtColor(colours.reshape(-1, 1, 3), cv2.COLOR_BGR2LAB).reshape(-1, 3).astype(int)
    light = lab[:, 0] * LIGHT // 256
    chroma = ((lab[:, 1:] - 128) // _CHROMA_STEP + CHROMA // 2).clip(0, CHROMA - 1)
    bins: np.ndarray = ((light * CHROMA + chroma[:, 0]) * CHROMA + chroma[:, 1]).astype(np.uint16)
    return bins


_TABLE = _table()
#: What a count adds up to as a feature.
_ROOTS = (_WEIGHT * np.sqrt(np.arange(_COUNTED**2 + 1) / _COUNTED**2)).astype(np.float32)
_STEPS = np.diff(_ROOTS)  # and what one more of a shade adds


@kernel("void(uint8[:,:,:], uint16[::1], uint16[:,::1])")
def _look_up(image: UInt8, table: UInt16, found: UInt16) -> None:
    for y in range(found.shape[0]):
        for x in range(found.shape[1]):
            place = 0  # the first 5 bits of each channel's mean, one after the other
            for channel in range(3):
                above = np.int64(image[2 * y, 2 * x, channel]) + image[2 * y, 2 * x + 1, channel]
                below = np.int64(image[2 * y + 1, 2 * x, channel]) + image[2 * y + 1, 2 * x + 1, channel]
                mean = (above + below + 2) >> 2
                place = place << 5 | mean >> 3
            found[y, x] = table[place]


@kernel("void(uint16[:,::1], int64, int64, float32[::1], int64[::1], float32[::1])")
def _histogram(found: UInt16, top: int, left: int, roots: Float32, counts: Int64, features: Float32) -> None:
    for shade in range(len(counts)):
        counts[shade] = 0
    for y in range(top, top + _COUNTED):
        for x in range(left, left + _COUNTED):
            counts[found[y, x]] += 1
    for shade in range(len(features)):
        features[shade] = roots[counts[shade]]


@kernel("void(uint16[:,::1], float32[::1], float32[::1], float32, int64[::1], float32[:,::1])")
def _add_scores(found: UInt16, weights: Float32, steps: Float32, least: float, counts: Int64, scores: Float32) -> None:
    for row in range(scores.shape[0]):
        top, last, total = row * SIDE + _EDGE, -2, 0.0
        for column in range(scores.shape[1]):
            if scores[row, column] < least:
                continue
            left = column * SIDE
            if last < column - 1:
                for shade in range(len(counts)):
                    counts[shade] = 0
                total = 0.0
                for y in range(top, top + _COUNTED):
                    for x in range(left + _EDGE, left + _EDGE + _COUNTED):
                        shade = found[y, x]
                        total += weights[shade] * steps[counts[shade]]
                        counts[shade] += 1
            else:
                # The window moves by one cell: its first column of shades leaves, and the one beside it enters.
                for y in range(top, top + _COUNTED):
                    for x in range(left, left + SIDE):
                        shade = found[y, x]
                        counts[shade] -= 1
                        total -= weights[shade] * steps[counts[shade]]
                    for x in range(left + _COUNTED, left + _COUNTED + SIDE):
                        shade = found[y, x]
                        total += weights[shade] * steps[counts[shade]]
                        counts[shade] += 1
            last = column
            scores[row, column] += total
