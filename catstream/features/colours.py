"""Colours: how much of each the middle of a window holds, wherever in it that is.

HOG and the mean colour of a cell say what is where. An object that bends or turns moves both
between the cells, but keeps its colours: 288 shades of Lab, 8 of lightness by 6 x 6 of a and b.
A window's histogram counts them in its middle 6 x 6 cells, which are mostly object; the square
root of each share is a feature, so that distances are Hellinger's.

Four pixels are averaged to one first: a cell has 4 x 4 shades.
"""

from __future__ import annotations

import numpy as np

from catstream.features import lab
from catstream.features.compiled import kernel
from catstream.features.layout import CHROMA, LIGHT, SHADES, SIDE, WINDOW
from catstream.numerics.arrays import Float32, UInt8, UInt16, writable

_CHROMA_STEP = 10  # Lab units from one level of a or b to the next
_WEIGHT = 3.0  # length of a histogram as features; that of a window's HOG is about 9
_COUNTED = WINDOW - 2  # cells along a side of the middle, whose shades are counted
_ROOT = np.float32(_WEIGHT / (_COUNTED * SIDE))  # what a count adds up to as a feature is its root times this
_LOWEST = float(np.finfo(np.float32).min)  # the kernels do not compute with infinity


def shades(planes: np.ndarray) -> np.ndarray:
    """The shade of every 2 x 2 pixels.

    Parameters
    ----------
    planes : uint8 (3, h, w), blue, green and red; h and w are even

    Returns
    -------
    uint16 (h // 2, w // 2), below `SHADES`

    >>> len(set(shades(np.array([[0, 0, 90, 90], [0, 0, 90, 90]], np.uint8)[None].repeat(3, axis=0)).ravel()))
    2
    """
    found = np.empty((planes.shape[1] // 2, planes.shape[2] // 2), np.uint16)
    _look_up(planes, _TABLE, found)
    return found


def count(found: UInt16, row: int, column: int, features: Float32) -> None:
    """Features of the window whose first cell is (row, column), into float32 (SHADES,): part of a kernel."""
    for shade in range(len(features)):
        features[shade] = 0
    for y in range((row + 1) * SIDE, (row + 1 + _COUNTED) * SIDE):
        for x in range((column + 1) * SIDE, (column + 1 + _COUNTED) * SIDE):
            features[found[y, x]] += 1
    for shade in range(len(features)):
        features[shade] = _ROOT * np.sqrt(features[shade])


def add_scores(found: np.ndarray, weights: np.ndarray, scores: np.ndarray, least: float = _LOWEST) -> None:
    """Add the score of the histogram of each window, in constant time a window.

    Parameters
    ----------
    found : uint16, as `shades` gives them
    weights : float32 (SHADES,)
    scores : float32 (rows - 7, columns - 7), of the window whose first cell is there
    least : windows with a lower score are left out, and their score stays as it is
    """
    strips = np.empty((scores.shape[1] + _COUNTED - 1, SHADES), np.uint16)
    _add_scores(found, writable(weights), least, strips, np.empty(SHADES, np.uint16), scores)


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
    found = lab.converted(colours.reshape(-1, 3)).astype(int)
    light = found[:, 0] * LIGHT // 256
    chroma = ((found[:, 1:] - 128) // _CHROMA_STEP + CHROMA // 2).clip(0, CHROMA - 1)
    bins: np.ndarray = ((light * CHROMA + chroma[:, 0]) * CHROMA + chroma[:, 1]).astype(np.uint16)
    return bins


_TABLE = _table()


@kernel("void(uint8[:,:,:], uint16[::1], uint16[:,::1])")
def _look_up(planes: UInt8, table: UInt16, found: UInt16) -> None:
    for y in range(found.shape[0]):
        for x in range(found.shape[1]):
            place = 0  # the first 5 bits of each channel's mean, one after the other
            for channel in range(3):
                above = np.int64(planes[channel, 2 * y, 2 * x]) + planes[channel, 2 * y, 2 * x + 1]
                below = np.int64(planes[channel, 2 * y + 1, 2 * x]) + planes[channel, 2 * y + 1, 2 * x + 1]
                mean = (above + below + 2) >> 2
                place = place << 5 | mean >> 3
            found[y, x] = table[place]


@kernel("void(uint16[:,::1], float32[::1], float32, uint16[:,::1], uint16[::1], float32[:,::1])")
def _add_scores(found: UInt16, weights: Float32, least: float, strips: UInt16, counts: UInt16, scores: Float32) -> None:
    """Add the score of the histogram of each window.

    A strip is the histogram of the cells of a column that the windows of a row count. From one row of windows to the
    next, a cell leaves each strip and another enters; from one window to the next, a strip leaves and another enters.

    Scratch: strips (columns + 5, SHADES), counts (SHADES,).
    """
    for row in range(len(scores)):
        top = (row + 1) * SIDE
        for column in range(len(strips)):
            strip, left = strips[column], (column + 1) * SIDE
            if row:
                for y in range(top - SIDE, top):
                    for x in range(left, left + SIDE):
                        strip[found[y, x]] -= 1
            else:
                for shade in range(len(strip)):
                    strip[shade] = 0
            for y in range(top + (_COUNTED - 1) * SIDE if row else top, top + _COUNTED * SIDE):
                for x in range(left, left + SIDE):
                    strip[found[y, x]] += 1
        for shade in range(len(counts)):
            counts[shade] = 0
            for column in range(_COUNTED - 1):
                counts[shade] += strips[column, shade]
        for column in range(scores.shape[1]):
            enters, leaves = strips[column + _COUNTED - 1], strips[column]
            for shade in range(len(counts)):
                counts[shade] += enters[shade]
            if scores[row, column] >= least:
                total = np.float32(0)
                for shade in range(len(counts)):
                    total += weights[shade] * np.sqrt(np.float32(counts[shade]))
                scores[row, column] += _ROOT * total
            for shade in range(len(counts)):
                counts[shade] -= leaves[shade]
