"""Features of an image: dense histograms of oriented gradients, and colour.

Each cell of 8 x 8 pixels has 31 HOG channels (18 signed and 9 unsigned
orientations, 4 texture energies; Felzenszwalb et al. 2010), of the colour
channel with the strongest gradient, then its mean colour in Lab.
A window of 64 x 64 pixels is 8 x 8 cells.

The kernel makes one pass over the pixels: magnitude and orientation of a
gradient come from tables, indexed by its two differences. It is compiled once
and kept in a cache folder, so that a second start needs no compiler.
"""

from __future__ import annotations

import getpass
import os
import tempfile
from pathlib import Path

import cv2
import numba
import numpy as np

__all__ = ["CELL", "CHANNELS", "MARGIN", "WINDOW", "grid"]

CELL = 8  #: pixels a cell is wide and high
WINDOW = 8  #: cells a window is wide and high
CHANNELS = 34  #: numbers a cell: 31 HOG, 3 colour
MARGIN = 2  #: cells around a crop beyond which no pixel changes a feature

_ORIENTATIONS = 9
_CLIP = 0.2  # a normalised bin is cut here (Dalal and Triggs 2005)
_COLOUR_WEIGHT = 1.5
_LAB_MIDDLE = np.array([128.0, 128.0, 128.0], np.float32)
_LAB_SCALE = np.array([1.0, 3.0, 3.0], np.float32) * np.float32(_COLOUR_WEIGHT / 255)


def grid(image: np.ndarray) -> np.ndarray:
    """Features of every whole cell of an image.

    A cell's features depend on pixels up to `MARGIN` cells away: the grid of a
    crop equals the slice of the frame's grid, but for that margin.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR, or (h, w) grey

    Returns
    -------
    float32 (h // 8, w // 8, 34)

    >>> grid(np.zeros((64, 96, 3), np.uint8)).shape
    (8, 12, 34)
    """
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    rows, columns = image.shape[0] // CELL, image.shape[1] // CELL
    image = np.ascontiguousarray(image[: rows * CELL, : columns * CELL])
    cells = np.empty((rows, columns, CHANNELS), np.float32)
    if cells.size:
        _hog(image, _MAGNITUDE, _ORIENTATION, _SHARES, cells)
        # The mean colour, converted, costs a tenth of the converted colours' mean and differs by little.
        colour = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA).reshape(rows, columns, 3)
        cells[:, :, 31:] = (cv2.cvtColor(colour, cv2.COLOR_BGR2LAB) - _LAB_MIDDLE) * _LAB_SCALE
    return cells


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Magnitude and signed orientation (0 ... 17) of every pair of differences, dy first."""
    difference = np.arange(-255, 256, dtype=np.float32)
    dy, dx = np.meshgrid(difference, difference, indexing="ij")
    turn = np.arctan2(dy, dx) / (2 * np.pi)
    orientation = np.rint(turn * 2 * _ORIENTATIONS).astype(np.int64) % (2 * _ORIENTATIONS)
    return np.hypot(dy, dx), orientation.astype(np.uint8)


def _cache_folder() -> str:
    """Where compiled kernels are kept: beside the code only if that can be written."""
    beside = Path(__file__).parent
    if os.access(beside, os.W_OK):
        return str(beside / "__pycache__")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    for folder in (Path(home) / "catstream", Path(tempfile.gettempdir()) / f"catstream-{getpass.getuser()}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return str(beside / "__pycache__")


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = _cache_folder()  # type: ignore[attr-defined]

_MAGNITUDE, _ORIENTATION = _tables()
#: For each pixel of a cell: its share in the cell itself; the rest goes to the neighbour on its side.
_SHARES = (1 - np.abs((np.arange(CELL) + 0.5) / CELL - 0.5)).astype(np.float32)


@numba.njit(
    "void(uint8[:,:,::1], float32[:,::1], uint8[:,::1], float32[::1], float32[:,:,::1])",
    cache=True,
    nogil=True,
    fastmath=True,
)
def _hog(image, magnitudes, orientations, shares, cells):
    height, width = image.shape[:2]
    rows, columns = height // CELL, width // CELL
    # One cell more on every side takes the shares that fall outside.
    histogram = np.zeros((rows + 2, columns + 2, 2 * _ORIENTATIONS), np.float32)
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        row = y // CELL + 1
        other_row = row - 1 if y % CELL < CELL // 2 else row + 1
        share_y = shares[y % CELL]
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            best_x = np.int32(0)
            best_y = np.int32(0)
            best = np.int32(-1)
            for channel in range(3):
                dx = np.int32(image[y, right, channel]) - np.int32(image[y, left, channel])
                dy = np.int32(image[below, x, channel]) - np.int32(image[above, x, channel])
                strength = dx * dx + dy * dy
                if strength > best:
                    best, best_x, best_y = strength, dx, dy
            magnitude = magnitudes[best_y + 255, best_x + 255]
            orientation = orientations[best_y + 255, best_x + 255]
            column = x // CELL + 1
            other_column = column - 1 if x % CELL < CELL // 2 else column + 1
            share_x = shares[x % CELL]
            near, far = magnitude * share_y, magnitude * (np.float32(1) - share_y)
            histogram[row, column, orientation] += near * share_x
            histogram[row, other_column, orientation] += near * (np.float32(1) - share_x)
            histogram[other_row, column, orientation] += far * share_x
            histogram[other_row, other_column, orientation] += far * (np.float32(1) - share_x)

    energy = np.empty((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            total = np.float32(0)
            for o in range(_ORIENTATIONS):
                both = histogram[row + 1, column + 1, o] + histogram[row + 1, column + 1, o + _ORIENTATIONS]
                total += both * both
            energy[row, column] = total

    clip = np.float32(_CLIP)
    for row in range(rows):
        up, down = max(row - 1, 0), min(row + 1, rows - 1)
        for column in range(columns):
            left, right = max(column - 1, 0), min(column + 1, columns - 1)
            side_up = energy[up, column] + energy[row, column]
            side_down = energy[down, column] + energy[row, column]
            small = np.float32(1e-4)
            a = np.float32(1) / np.sqrt(side_up + energy[up, left] + energy[row, left] + small)
            b = np.float32(1) / np.sqrt(side_up + energy[up, right] + energy[row, right] + small)
            c = np.float32(1) / np.sqrt(side_down + energy[down, left] + energy[row, left] + small)
            d = np.float32(1) / np.sqrt(side_down + energy[down, right] + energy[row, right] + small)
            texture_a = texture_b = texture_c = texture_d = np.float32(0)
            for o in range(2 * _ORIENTATIONS):
                value = histogram[row + 1, column + 1, o]
                in_a, in_b = min(value * a, clip), min(value * b, clip)
                in_c, in_d = min(value * c, clip), min(value * d, clip)
                cells[row, column, o] = np.float32(0.5) * (in_a + in_b + in_c + in_d)
                texture_a += in_a
                texture_b += in_b
                texture_c += in_c
                texture_d += in_d
            for o in range(_ORIENTATIONS):
                value = histogram[row + 1, column + 1, o] + histogram[row + 1, column + 1, o + _ORIENTATIONS]
                total = min(value * a, clip) + min(value * b, clip) + min(value * c, clip) + min(value * d, clip)
                cells[row, column, 2 * _ORIENTATIONS + o] = np.float32(0.5) * total
            weight = np.float32(0.2357)  # 1 / sqrt(18), as published
            cells[row, column, 27] = weight * texture_a
            cells[row, column, 28] = weight * texture_b
            cells[row, column, 29] = weight * texture_c
            cells[row, column, 30] = weight * texture_d
