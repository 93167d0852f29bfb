"""Features of an image: dense histograms of oriented gradients, and colour.

Each cell of 8 x 8 pixels has 31 HOG channels (18 signed and 9 unsigned
orientations, 4 texture energies; Felzenszwalb et al. 2010), of the colour
channel with the strongest gradient, then its mean colour in Lab.
A window of 64 x 64 pixels is 8 x 8 cells.

The kernel goes line by line: what a line's pixels do is written so that the
compiler does eight of them at once. Only counting them is one by one, but
each pixel is added to its four nearest cells at once.
"""

from __future__ import annotations

import numpy as np
from numpy import float32

from catstream.features.compiled import kernel
from catstream.features.lab import of_colour
from catstream.features.layout import CELL, CHANNELS
from catstream.numerics.arrays import Float32, UInt8
from catstream.numerics.parallel import Scratch

_ORIENTATIONS = 9
_SIGNED = 2 * _ORIENTATIONS
_HALF = CELL // 2
_CLIP = np.float32(0.2)  # a normalised bin is cut here (Dalal and Triggs 2005)
_TEXTURE = np.float32(0.2357)  # 1 / sqrt(18), as published
_COLOUR_WEIGHT = 1.5
_LIGHT_SCALE = np.float32(_COLOUR_WEIGHT / 255)
_CHROMA_SCALE = np.float32(3) * _LIGHT_SCALE
_LAB_MIDDLE = 128
_MOST_KEPT = 1024  # cells of an image whose scratch is kept: a patch, and no whole frame
#: Orientations are 20 degrees apart: the tangents of where one ends and the next begins, from 0 to 90.
_TAN_10, _TAN_30, _TAN_50, _TAN_70 = np.tan(np.deg2rad([10, 30, 50, 70])).astype(np.float32)


def _shares() -> np.ndarray:
    """Share of each pixel between the centres of four cells in each of these, float32 (8, 8, 4): row by row."""
    far = (np.arange(CELL) + 0.5) / CELL
    near = 1 - far
    shares = [np.outer(down, across) for down in (near, far) for across in (near, far)]
    return np.stack(shares, axis=-1).astype(np.float32)


_SHARES = _shares()


def grid(planes: np.ndarray, margin: int = 0) -> np.ndarray:
    """Features of every whole cell of an image.

    A cell's features depend on pixels up to `MARGIN` cells away: the grid of a
    crop equals the slice of the frame's grid, but for that margin.

    Parameters
    ----------
    planes : uint8 (3, h, w), blue, green and red of the image
    margin : cells along each edge that are left out

    Returns
    -------
    float32 (h // 8 - 2 margin, w // 8 - 2 margin, 34)

    >>> grid(np.zeros((3, 64, 96), np.uint8)).shape
    (8, 12, 34)
    """
    rows, columns = planes.shape[1] // CELL, planes.shape[2] // CELL
    cells = np.empty((max(rows - 2 * margin, 0), max(columns - 2 * margin, 0), CHANNELS), np.float32)
    if cells.size:
        arrays = _scratch.kept if rows * columns <= _MOST_KEPT else _scratch.made
        _describe(planes, margin, _SHARES, cells, *arrays(rows, columns))
    return cells


@Scratch
def _scratch(rows: int, columns: int) -> tuple[np.ndarray, ...]:
    """The arrays for intermediate results of `_describe`."""
    width = columns * CELL
    return (
        np.empty((3, 3, width + 2), np.float32),
        np.empty((3, width + CELL), np.float32),
        np.empty(width + CELL, np.uint8),
        np.empty((columns + 1, _SIGNED, 4), np.float32),
        np.empty((rows + 2, columns + 2, _SIGNED), np.float32),
        np.empty((rows, columns), np.float32),
    )


def _read(planes: UInt8, y: int, line: Float32) -> None:
    """The three channels of one row of pixels, the pixels at the edge twice."""
    width = line.shape[1] - 2
    for channel in range(3):
        values, row = line[channel], planes[channel, y]
        for x in range(width):
            values[x + 1] = row[x]
        values[0], values[width + 1] = values[1], values[width]


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


def _add(magnitude: Float32, orientation: UInt8, shares: Float32, blocks: Float32) -> None:
    """Add a line's pixels to the four shares of their orientation in the block of 8 x 8 pixels that they lie in."""
    for i in range(CELL):  # not block by block: to add to what was just added to is slow
        above_left, above_right, below_left, below_right = shares[i, 0], shares[i, 1], shares[i, 2], shares[i, 3]
        for block in range(blocks.shape[0]):
            strength = magnitude[block * CELL + i]
            four = blocks[block, orientation[block * CELL + i]]
            a, b = four[0] + strength * above_left, four[1] + strength * above_right
            c, d = four[2] + strength * below_left, four[3] + strength * below_right
            four[0], four[1], four[2], four[3] = a, b, c, d


def _count(
    planes: UInt8,
    margin: int,
    shares: Float32,
    lines: Float32,
    gradients: Float32,
    orientation: UInt8,
    blocks: Float32,
    histogram: Float32,
) -> None:
    """Histograms of the cells within a margin."""
    rows, columns = histogram.shape[0] - 2, histogram.shape[1] - 2
    height, width = rows * CELL, columns * CELL
    across, down, magnitude = gradients[0], gradients[1], gradients[2]
    inner = slice(margin * CELL, (columns + 1 - margin) * CELL)
    for x in range(len(magnitude)):
        magnitude[x] = orientation[x] = 0
    for row in range(rows + 2):
        for column in range(columns + 2):
            for o in range(_SIGNED):
                histogram[row, column, o] = 0
    for band in range(margin, rows + 1 - margin):  # of the pixels between the centres of two rows of cells
        for block in range(margin, columns + 1 - margin):
            for o in range(_SIGNED):
                for share in range(4):
                    blocks[block, o, share] = 0
        top, bottom = max(band * CELL - _HALF, 0), min(band * CELL + _HALF, height)
        if band == margin:
            _read(planes, max(top - 1, 0), lines[(top + 2) % 3])
            _read(planes, top, lines[top % 3])
        for y in range(top, bottom):
            above, here, below = lines[(y + 2) % 3], lines[y % 3], lines[(y + 1) % 3]
            _read(planes, min(y + 1, height - 1), below)
            _gradients(above, here, below, across[:width], down[:width], magnitude[_HALF : _HALF + width])
            _orientations(across[:width], down[:width], orientation[_HALF : _HALF + width])
            line = shares[(y + _HALF) % CELL]
            _add(magnitude[inner], orientation[inner], line, blocks[margin : columns + 1 - margin])
        for block in range(margin, columns + 1 - margin):
            for o in range(_SIGNED):
                histogram[band, block, o] += blocks[block, o, 0]
                histogram[band, block + 1, o] += blocks[block, o, 1]
                histogram[band + 1, block, o] += blocks[block, o, 2]
                histogram[band + 1, block + 1, o] += blocks[block, o, 3]


def _average(plane: UInt8, row: int, column: int) -> int:
    """The mean of one channel of a cell's pixels."""
    total = float32(CELL * CELL // 2)  # half, to round; floats are added eight at once
    for y in range(row * CELL, (row + 1) * CELL):
        for x in range(column * CELL, (column + 1) * CELL):
            total += float32(plane[y, x])
    return int(total) // (CELL * CELL)


def _colour(planes: UInt8, margin: int, cells: Float32) -> None:
    """The mean colour of each cell, converted to Lab (decision 11)."""
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            y, x = row + margin, column + margin
            blue, green, red = _average(planes[0], y, x), _average(planes[1], y, x), _average(planes[2], y, x)
            light, a, b = of_colour(blue, green, red)
            cells[row, column, 31] = float32(light - _LAB_MIDDLE) * _LIGHT_SCALE
            cells[row, column, 32] = float32(a - _LAB_MIDDLE) * _CHROMA_SCALE
            cells[row, column, 33] = float32(b - _LAB_MIDDLE) * _CHROMA_SCALE


def _normalise(histogram: Float32, margin: int, energy: Float32, cells: Float32) -> None:
    """Each cell's histogram by the energies of the four blocks of 2 x 2 cells that it is in."""
    rows, columns = energy.shape
    for row in range(rows):
        for column in range(columns):
            bins = histogram[row + 1, column + 1]
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
            bins = histogram[row + 1, column + 1]
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


@kernel(
    "void(uint8[:,:,::1], int64, float32[:,:,::1], float32[:,:,::1], float32[:,:,::1], float32[:,::1], uint8[::1], "
    "float32[:,:,::1], float32[:,:,::1], float32[:,::1])"
)
def _describe(
    planes: UInt8,
    margin: int,
    shares: Float32,
    cells: Float32,
    lines: Float32,
    gradients: Float32,
    orientation: UInt8,
    blocks: Float32,
    histogram: Float32,
    energy: Float32,
) -> None:
    """HOG and mean colour of the cells within the margin.

    Scratch: lines (3, 3, width + 2), the three channels of the rows above, here and below, in turns; of a row with half
    a cell more on either side, gradients (3, width + 8), across, down and magnitude, and orientation (width + 8,);
    blocks (columns + 1, 18, 4), of the pixels between the centres of four cells their shares in each; energy
    (rows, columns); histogram (rows + 2, columns + 2, 18), with one cell more on every side, which takes what falls
    outside.
    """
    _count(planes, max(margin - 1, 0), shares, lines, gradients, orientation, blocks, histogram)
    _normalise(histogram, margin, energy, cells)
    _colour(planes, margin, cells)
