"""Features of an image: dense histograms of oriented gradients, and colour.

Each cell of 8 x 8 pixels has 31 HOG channels (18 signed and 9 unsigned
orientations, 4 texture energies; Felzenszwalb et al. 2010), of the colour
channel with the strongest gradient, then its mean colour in Lab.
A window of 64 x 64 pixels is 8 x 8 cells.

The kernel goes line by line: what a line's pixels do is written so that the
compiler does eight of them at once, and only counting them is one by one.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy import float32

from catstream.arrays import Float32, UInt8
from catstream.features.compiled import kernel
from catstream.features.layout import CELL, CHANNELS

__all__ = ["grid"]

_ORIENTATIONS = 9
_SIGNED = 2 * _ORIENTATIONS
_CLIP = np.float32(0.2)  # a normalised bin is cut here (Dalal and Triggs 2005)
_TEXTURE = np.float32(0.2357)  # 1 / sqrt(18), as published
_COLOUR_WEIGHT = 1.5
_LAB_MIDDLE = np.array([128.0, 128.0, 128.0], np.float32)
_LAB_SCALE = np.array([1.0, 3.0, 3.0], np.float32) * np.float32(_COLOUR_WEIGHT / 255)
#: Orientations are 20 degrees apart: the tangents of where one ends and the next begins, from 0 to 90.
_TAN_10, _TAN_30, _TAN_50, _TAN_70 = np.tan(np.deg2rad([10, 30, 50, 70])).astype(np.float32)
#: For each pixel of a cell: its share in the cell itself; the rest goes to the neighbour on its side.
_SHARES = (1 - np.abs((np.arange(CELL) + 0.5) / CELL - 0.5)).astype(np.float32)


def grid(image: np.ndarray, margin: int = 0) -> np.ndarray:
    """Features of every whole cell of an image.

    A cell's features depend on pixels up to `MARGIN` cells away: the grid of a
    crop equals the slice of the frame's grid, but for that margin.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR
    margin : cells along each edge that are left out

    Returns
    -------
    float32 (h // 8 - 2 margin, w // 8 - 2 margin, 34)

    >>> grid(np.zeros((64, 96, 3), np.uint8)).shape
    (8, 12, 34)
    """
    rows, columns = image.shape[0] // CELL, image.shape[1] // CELL
    histogram = np.zeros((rows + 2, (columns + 2) * _SIGNED), np.float32)
    colour = np.empty((rows, columns, 3), np.uint8)
    cells = np.empty((max(rows - 2 * margin, 0), max(columns - 2 * margin, 0), CHANNELS), np.float32)
    if cells.size:
        blue, green, red = channels = [np.asarray(channel, np.uint8) for channel in cv2.split(image)]
        width = columns * CELL
        lines, gradients = np.empty((3, 3, width + 2), np.float32), np.empty((3, width), np.float32)
        orientation, turns = np.empty(width, np.uint8), np.empty((2, histogram.shape[1]), np.float32)
        _count(blue, green, red, _SHARES, lines, gradients, orientation, turns, histogram)
        _normalise(histogram, margin, np.empty((rows, columns), np.float32), cells)
        for i, channel in enumerate(channels):
            _average(channel, colour[:, :, i])
        # The mean colour, converted, costs a tenth of the converted colours' mean and differs by little.
        lab = cv2.cvtColor(colour, cv2.COLOR_BGR2LAB)[margin : rows - margin, margin : columns - margin]
        cells[:, :, 31:] = (lab - _LAB_MIDDLE) * _LAB_SCALE
    return cells


def _read(row: UInt8, line: Float32) -> None:
    """One row of a channel, each pixel at the edge twice."""
    width = len(row)
    for x in range(width):
        line[x + 1] = row[x]
    line[0], line[width + 1] = row[0], row[width - 1]


def _gradients(
    above: Float32, here: Float32, below: Float32, across: Float32, down: Float32, magnitude: Float32
) -> None:
    """The strongest channel's gradient at each pixel of a row."""
    blue, green, red = here[0], here[1], here[2]
    blue_above, green_above, red_above = above[0], above[1], above[2]
    blue_below, green_below, red_below = below[0], below[1], below[2]
    for x in range(len(magnitude)):
        dx, dy = blue[x + 2] - blue[x], blue_below[x + 1] - blue_above[x + 1]
        most = dx * dx + dy * dy
        other_x, other_y = green[x + 2] - green[x], green_below[x + 1] - green_above[x + 1]
        strength = other_x * other_x + other_y * other_y
        if strength > most:
            most, dx, dy = strength, other_x, other_y
        other_x, other_y = red[x + 2] - red[x], red_below[x + 1] - red_above[x + 1]
        strength = other_x * other_x + other_y * other_y
        if strength > most:
            most, dx, dy = strength, other_x, other_y
        across[x], down[x] = dx, dy
        magnitude[x] = np.sqrt(most)


def _orientations(across: Float32, down: Float32, orientation: UInt8) -> None:
    """Which of 18 directions, 0 ... 17, each gradient points to."""
    for x in range(len(orientation)):
        dx, dy = across[x], down[x]
        flat, steep = abs(dx), abs(dy)
        o = float32(steep > flat * _TAN_10) + float32(steep > flat * _TAN_30)
        o += float32(steep > flat * _TAN_50) + float32(steep > flat * _TAN_70)
        o = float32(_ORIENTATIONS) - o if dx < float32(0) else o
        o = float32(_SIGNED) - o if dy < float32(0) else o
        orientation[x] = np.uint8(float32(0) if o == float32(_SIGNED) else o)


@kernel(
    "void(uint8[:,::1], uint8[:,::1], uint8[:,::1], float32[::1], "
    "float32[:,:,::1], float32[:,::1], uint8[::1], float32[:,::1], float32[:,::1])"
)
def _count(
    blue: UInt8,
    green: UInt8,
    red: UInt8,
    shares: Float32,
    lines: Float32,
    gradients: Float32,
    orientation: UInt8,
    turns: Float32,
    histogram: Float32,
) -> None:
    """Histograms of the cells, with one cell more on every side, which takes what falls outside.

    Scratch: lines (3, 3, width + 2), the three channels of the rows above, here and below, in turns; gradients
    (3, width), across, down and their magnitude; orientation (width,); turns (2, columns of the histogram).
    """
    columns = histogram.shape[1] // _SIGNED - 2
    height, width = (histogram.shape[0] - 2) * CELL, columns * CELL
    across, down, magnitude = gradients[0], gradients[1], gradients[2]
    # Neighbours often have the same orientation, and adding to what was just added to is slow: they take turns.
    even, odd = turns[0], turns[1]
    for y in range(-2, height):
        below, at = lines[(y + 1) % 3], min(max(y + 1, 0), height - 1)
        _read(blue[at, :width], below[0])
        _read(green[at, :width], below[1])
        _read(red[at, :width], below[2])
        if y < 0:
            continue
        here = lines[y % 3]
        _gradients(lines[(y - 1) % 3], here, below, across, down, magnitude)
        _orientations(across, down, orientation)
        for i in range(len(even)):
            even[i] = odd[i] = 0
        for column in range(columns):
            for i in range(CELL):
                x = column * CELL + i
                own = (column + 1) * _SIGNED
                other = own - _SIGNED if i < CELL // 2 else own + _SIGNED
                near = magnitude[x] * shares[i]
                line = odd if i % 2 else even
                line[own + orientation[x]] += near
                line[other + orientation[x]] += magnitude[x] - near
        share = shares[y % CELL]
        row = histogram[y // CELL + 1]
        other_row = histogram[y // CELL if y % CELL < CELL // 2 else y // CELL + 2]
        for i in range(len(row)):
            row[i] += share * (even[i] + odd[i])
            other_row[i] += (float32(1) - share) * (even[i] + odd[i])


@kernel("void(uint8[:,::1], uint8[:,:])")
def _average(channel: UInt8, means: UInt8) -> None:
    """The mean of each cell's pixels."""
    for row in range(means.shape[0]):
        for column in range(means.shape[1]):
            total = CELL * CELL // 2  # half, to round
            for y in range(row * CELL, (row + 1) * CELL):
                for x in range(column * CELL, (column + 1) * CELL):
                    total += channel[y, x]
            means[row, column] = total // (CELL * CELL)


@kernel("void(float32[:,::1], int64, float32[:,::1], float32[:,:,::1])")
def _normalise(histogram: Float32, margin: int, energy: Float32, cells: Float32) -> None:
    """Each cell's histogram by the energies of the four blocks of 2 x 2 cells that it is in.

    Scratch: energy (rows, columns).
    """
    rows, columns = histogram.shape[0] - 2, histogram.shape[1] // _SIGNED - 2
    for row in range(rows):
        for column in range(columns):
            bins = histogram[row + 1, (column + 1) * _SIGNED :]
            total = float32(0)
            for o in range(_ORIENTATIONS):
                both = bins[o] + bins[o + _ORIENTATIONS]
                total += both * both
            energy[row, column] = total

    half, small = float32(0.5), float32(1e-4)
    for row in range(margin, rows - margin):
        up, down = max(row - 1, 0), min(row + 1, rows - 1)
        for column in range(margin, columns - margin):
            left, right = max(column - 1, 0), min(column + 1, columns - 1)
            above = energy[up, column] + energy[row, column]
            below = energy[down, column] + energy[row, column]
            a = float32(1) / np.sqrt(above + energy[up, left] + energy[row, left] + small)
            b = float32(1) / np.sqrt(above + energy[up, right] + energy[row, right] + small)
            c = float32(1) / np.sqrt(below + energy[down, left] + energy[row, left] + small)
            d = float32(1) / np.sqrt(below + energy[down, right] + energy[row, right] + small)
            bins = histogram[row + 1, (column + 1) * _SIGNED :]
            features = cells[row - margin, column - margin]
            texture_a = texture_b = texture_c = texture_d = float32(0)
            for o in range(_SIGNED):
                in_a, in_b = min(bins[o] * a, _CLIP), min(bins[o] * b, _CLIP)
                in_c, in_d = min(bins[o] * c, _CLIP), min(bins[o] * d, _CLIP)
                features[o] = half * (in_a + in_b + in_c + in_d)
                texture_a += in_a
                texture_b += in_b
                texture_c += in_c
                texture_d += in_d
            for o in range(_ORIENTATIONS):
                both = bins[o] + bins[o + _ORIENTATIONS]
                total = min(both * a, _CLIP) + min(both * b, _CLIP) + min(both * c, _CLIP) + min(both * d, _CLIP)
                features[_SIGNED + o] = half * total
            features[27] = _TEXTURE * texture_a
            features[28] = _TEXTURE * texture_b
            features[29] = _TEXTURE * texture_c
            features[30] = _TEXTURE * texture_d
