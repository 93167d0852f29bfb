"""Kernels of cells: HOG, colours and feature rows of an image, and the scores of its windows.

They are one file, since they call one another (see `catstream.features.compilation`). For the same reason, constants of
`catstream.features.layout` are repeated here; a test compares them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import float32

from catstream.base.arrays import Float32, Int64, UInt8, UInt16
from catstream.features.compilation import function, kernel

_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}

CELL, WINDOW, CHANNELS, SIDE = 8, 8, 34, 4  # as in layout.py
_CELL_FEATURES = WINDOW * WINDOW * CHANNELS  # in a row, before the histogram of colours
_ORIENTATIONS = 9
_SIGNED = 2 * _ORIENTATIONS
_HALF = CELL // 2
_CLIP = float32(0.2)  # upper limit of a normalised bin (Dalal and Triggs 2005)
_TEXTURE = float32(0.2357)  # 1 / sqrt(18), as published
_COLOUR_WEIGHT = 1.5
_LIGHT_SCALE = float32(_COLOUR_WEIGHT / 255)
_CHROMA_SCALE = float32(3) * _LIGHT_SCALE
_LAB_MIDDLE = 128
#: Tangents of the limits between orientations, which are 20 degrees apart, from 0 to 90.
_TAN_10, _TAN_30, _TAN_50, _TAN_70 = np.tan(np.deg2rad([10, 30, 50, 70])).astype(np.float32)

COLOUR_LENGTH = 3.0  #: norm of the histogram of colours in a row; the norm of a window's HOG is about 9
COUNTED = WINDOW - 2  #: cells along a side of the middle of a window, whose shades are counted
_ROOT = float32(COLOUR_LENGTH / (COUNTED * SIDE))  # factor of the root of a count, as a feature

_LINEAR_BITS, _ROOT_BITS, _SHARE_BITS = 3, 15, 12  # fractional bits of fixed-point numbers


def _linear() -> np.ndarray:
    """Linear light of each of the 256 levels of sRGB."""
    level = np.arange(256) / 255
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    levels: np.ndarray = np.rint((255 << _LINEAR_BITS) * light).astype(np.int32)
    return levels


def _roots() -> np.ndarray:
    """The root of CIE Lab of each linear light, to 1.5 times white."""
    light = np.arange(256 * 3 // 2 << _LINEAR_BITS) / (255 << _LINEAR_BITS)
    root = np.where(light < 216 / 24389, light * (841 / 108) + 16 / 116, np.cbrt(light))
    roots: np.ndarray = np.rint(root * (1 << _ROOT_BITS)).astype(np.int32)
    return roots


_LINEAR, _ROOTS = _linear(), _roots()
#: Shares of red, green and blue in X, Y and Z, which are 1 for the white of D65.
_XYZ = [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
_XYZ_SHARES = np.rint(np.divide(_XYZ, [[0.950456], [1.0], [1.088754]]) * (1 << _SHARE_BITS)).astype(np.int32)
_ZERO_LIGHT = (16 * 255 * (1 << _ROOT_BITS) + 50) // 100  # 116 roots less the lightness


@function(**_OPTIONS)
def _lab(blue: int, green: int, red: int) -> tuple[int, int, int]:
    """Lab of a colour."""
    r, g, b = _LINEAR[red], _LINEAR[green], _LINEAR[blue]
    half = 1 << (_SHARE_BITS - 1)
    x = _ROOTS[(r * _XYZ_SHARES[0, 0] + g * _XYZ_SHARES[0, 1] + b * _XYZ_SHARES[0, 2] + half) >> _SHARE_BITS]
    y = _ROOTS[(r * _XYZ_SHARES[1, 0] + g * _XYZ_SHARES[1, 1] + b * _XYZ_SHARES[1, 2] + half) >> _SHARE_BITS]
    z = _ROOTS[(r * _XYZ_SHARES[2, 0] + g * _XYZ_SHARES[2, 1] + b * _XYZ_SHARES[2, 2] + half) >> _SHARE_BITS]
    half = 1 << (_ROOT_BITS - 1)
    light = (296 * y - _ZERO_LIGHT + half) >> _ROOT_BITS
    return light, ((500 * (x - y) + half) >> _ROOT_BITS) + 128, ((200 * (y - z) + half) >> _ROOT_BITS) + 128


@kernel("void(uint8[:,::1], uint8[:,::1])", **_OPTIONS)
def convert_to_lab(colours: UInt8, lab: UInt8) -> None:
    """Convert colours, (k, 3), from blue, green, red to lightness, a, b, like OpenCV's `COLOR_BGR2LAB`.

    OpenCV first computes tables, for 90 ms in each process, which differ in a few entries between processors. The
    tables here are constant; a few colours in ten thousand differ from OpenCV's by one level.
    """
    for k in range(len(colours)):
        lab[k, 0], lab[k, 1], lab[k, 2] = _lab(colours[k, 0], colours[k, 1], colours[k, 2])


@function(**_OPTIONS)
def _read(planes: UInt8, y: int, line: Float32) -> None:
    """Read the three channels of a row of pixels, and duplicate the pixels at both ends."""
    width = line.shape[1] - 2
    for channel in range(3):
        values, row = line[channel], planes[channel, y]
        for x in range(width):
            values[x + 1] = row[x]
        values[0], values[width + 1] = values[1], values[width]


@function(**_OPTIONS)
def _gradients(
    above: Float32, here: Float32, below: Float32, across: Float32, down: Float32, magnitude: Float32
) -> None:
    """The strongest channel's gradient at each pixel of a row."""
    blue, green, red = here[0], here[1], here[2]
    blue_above, green_above, red_above = above[0], above[1], above[2]
    blue_below, green_below, red_below = below[0], below[1], below[2]
    for x in range(len(magnitude)):
        dx, dy = blue[x + 2] - blue[x], blue_below[x + 1] - blue_above[x + 1]
        largest = dx * dx + dy * dy
        other_x, other_y = green[x + 2] - green[x], green_below[x + 1] - green_above[x + 1]
        strength = other_x * other_x + other_y * other_y
        if strength > largest:
            largest, dx, dy = strength, other_x, other_y
        other_x, other_y = red[x + 2] - red[x], red_below[x + 1] - red_above[x + 1]
        strength = other_x * other_x + other_y * other_y
        if strength > largest:
            largest, dx, dy = strength, other_x, other_y
        across[x], down[x] = dx, dy
        magnitude[x] = np.sqrt(largest)


@function(**_OPTIONS)
def _orientations(across: Float32, down: Float32, orientation: UInt8) -> None:
    """Quantise the direction of each gradient to 0 ... 17."""
    for x in range(len(orientation)):
        dx, dy = across[x], down[x]
        flat, steep = abs(dx), abs(dy)
        o = float32(steep > flat * _TAN_10) + float32(steep > flat * _TAN_30)
        o += float32(steep > flat * _TAN_50) + float32(steep > flat * _TAN_70)
        o = float32(_ORIENTATIONS) - o if dx < float32(0) else o
        o = float32(_SIGNED) - o if dy < float32(0) else o
        orientation[x] = np.uint8(float32(0) if o == float32(_SIGNED) else o)


@function(**_OPTIONS)
def _add(magnitude: Float32, orientation: UInt8, shares: Float32, blocks: Float32) -> None:
    """Add the pixels of a line to the bins of their orientations, interpolated between the four cells of a block."""
    for i in range(CELL):  # not block by block: successive additions to one bin are slow
        above_left, above_right, below_left, below_right = shares[i, 0], shares[i, 1], shares[i, 2], shares[i, 3]
        for block in range(blocks.shape[0]):
            strength = magnitude[block * CELL + i]
            four = blocks[block, orientation[block * CELL + i]]
            a, b = four[0] + strength * above_left, four[1] + strength * above_right
            c, d = four[2] + strength * below_left, four[3] + strength * below_right
            four[0], four[1], four[2], four[3] = a, b, c, d


@function(**_OPTIONS)
def _count(planes: UInt8, margin: int, shares: Float32, histogram: Float32) -> None:
    """Compute the histograms of the cells within a margin."""
    rows, columns = histogram.shape[0] - 2, histogram.shape[1] - 2
    height, width = rows * CELL, columns * CELL
    lines = np.empty((3, 3, width + 2), np.float32)  # channels of three successive rows, in rotation
    across, down = np.empty(width, np.float32), np.empty(width, np.float32)
    magnitude = np.empty(width + CELL, np.float32)  # with half a cell of padding on either side
    orientation = np.empty(width + CELL, np.uint8)
    blocks = np.empty((columns + 1, _SIGNED, 4), np.float32)  # each spans the centres of four cells
    inner = slice(margin * CELL, (columns + 1 - margin) * CELL)
    # Step 1: clear the padding and the bins.
    for x in range(len(magnitude)):
        magnitude[x] = orientation[x] = 0
    for row in range(rows + 2):
        for column in range(columns + 2):
            for o in range(_SIGNED):
                histogram[row, column, o] = 0
    for band in range(margin, rows + 1 - margin):  # from the centres of one row of cells to the next
        for block in range(margin, columns + 1 - margin):
            for o in range(_SIGNED):
                for share in range(4):
                    blocks[block, o, share] = 0
        # Step 2: add the pixels of a band to the bins of its blocks, line by line.
        top, bottom = max(band * CELL - _HALF, 0), min(band * CELL + _HALF, height)
        if band == margin:
            _read(planes, max(top - 1, 0), lines[(top + 2) % 3])
            _read(planes, top, lines[top % 3])
        for y in range(top, bottom):
            above, here, below = lines[(y + 2) % 3], lines[y % 3], lines[(y + 1) % 3]
            _read(planes, min(y + 1, height - 1), below)
            _gradients(above, here, below, across, down, magnitude[_HALF : _HALF + width])
            _orientations(across, down, orientation[_HALF : _HALF + width])
            line = shares[(y + _HALF) % CELL]
            _add(magnitude[inner], orientation[inner], line, blocks[margin : columns + 1 - margin])
        # Step 3: add the four parts of each block to the four cells around it.
        for block in range(margin, columns + 1 - margin):
            for o in range(_SIGNED):
                histogram[band, block, o] += blocks[block, o, 0]
                histogram[band, block + 1, o] += blocks[block, o, 1]
                histogram[band + 1, block, o] += blocks[block, o, 2]
                histogram[band + 1, block + 1, o] += blocks[block, o, 3]


@function(**_OPTIONS)
def _average(plane: UInt8, row: int, column: int) -> int:
    """The mean of one channel of a cell's pixels."""
    total = float32(CELL * CELL // 2)  # half, to round; floats are added eight at a time
    for y in range(row * CELL, (row + 1) * CELL):
        for x in range(column * CELL, (column + 1) * CELL):
            total += float32(plane[y, x])
    return int(total) // (CELL * CELL)


@function(**_OPTIONS)
def _colour(planes: UInt8, margin: int, cells: Float32) -> None:
    """The mean colour of each cell, converted to Lab (decision 11)."""
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            y, x = row + margin, column + margin
            blue, green, red = _average(planes[0], y, x), _average(planes[1], y, x), _average(planes[2], y, x)
            light, a, b = _lab(blue, green, red)
            cells[row, column, 31] = float32(light - _LAB_MIDDLE) * _LIGHT_SCALE
            cells[row, column, 32] = float32(a - _LAB_MIDDLE) * _CHROMA_SCALE
            cells[row, column, 33] = float32(b - _LAB_MIDDLE) * _CHROMA_SCALE


@function(**_OPTIONS)
def _normalise(histogram: Float32, margin: int, cells: Float32) -> None:
    """Normalise the histogram of each cell by the energies of the four blocks of 2 x 2 cells around it."""
    # Step 1: the energy of each cell, over unsigned orientations.
    rows, columns = histogram.shape[0] - 2, histogram.shape[1] - 2
    energy = np.empty((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            bins = histogram[row + 1, column + 1]
            total = float32(0)
            for o in range(_ORIENTATIONS):
                both = bins[o] + bins[o + _ORIENTATIONS]
                total += both * both
            energy[row, column] = total
    # Step 2: the factors of the blocks a, b, c and d, which contain the cell and three neighbours each.
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
            # Step 3: the signed, then the unsigned orientations, then the texture energy in each block.
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


@kernel("void(uint8[:,:,::1], int64, float32[:,:,::1], float32[:,:,::1])", **_OPTIONS)
def describe_cells(planes: UInt8, margin: int, shares: Float32, cells: Float32) -> None:
    """HOG and mean colour of the cells within the margin.

    The loops over the pixels of a line are vectorised by the compiler, eight pixels at a time, except the update of the
    histograms, which adds a pixel to its four nearest cells at a time.
    """
    rows, columns = cells.shape[0] + 2 * margin, cells.shape[1] + 2 * margin
    histogram = np.empty((rows + 2, columns + 2, _SIGNED), np.float32)  # with a border for shares outside of the image
    _count(planes, max(margin - 1, 0), shares, histogram)
    _normalise(histogram, margin, cells)
    _colour(planes, margin, cells)


@kernel("void(uint8[:,:,:], uint16[::1], uint16[:,::1])", **_OPTIONS)
def look_up_shades(planes: UInt8, table: UInt16, shades: UInt16) -> None:
    """The shade of every 2 x 2 pixels of the planes blue, green and red, by a table of BGR colours of 5 bits each."""
    for y in range(shades.shape[0]):
        for x in range(shades.shape[1]):
            index = 0  # the upper 5 bits of the mean of each channel, concatenated
            for channel in range(3):
                above = np.int64(planes[channel, 2 * y, 2 * x]) + planes[channel, 2 * y, 2 * x + 1]
                below = np.int64(planes[channel, 2 * y + 1, 2 * x]) + planes[channel, 2 * y + 1, 2 * x + 1]
                mean = (above + below + 2) >> 2
                index = index << 5 | mean >> 3
            shades[y, x] = table[index]


@function(**_OPTIONS)
def _count_shades(shades: UInt16, row: int, column: int, features: Float32) -> None:
    """Features of the window whose first cell is (row, column), into float32 (SHADES,)."""
    for shade in range(len(features)):
        features[shade] = 0
    for y in range((row + 1) * SIDE, (row + 1 + COUNTED) * SIDE):
        for x in range((column + 1) * SIDE, (column + 1 + COUNTED) * SIDE):
            features[shades[y, x]] += 1
    for shade in range(len(features)):
        features[shade] = _ROOT * np.sqrt(features[shade])


@kernel("void(uint16[:,::1], float32[::1], float32, float32[:,::1])", **_OPTIONS)
def add_colour_scores(shades: UInt16, weights: Float32, threshold: float, scores: Float32) -> None:
    """Add the score of the histogram of each window.

    A strip is the histogram of the cells of a column that the windows of a row count. From one row of windows to the
    next, a cell leaves each strip and another enters; from one window to the next, a strip leaves and another enters.
    """
    strips = np.empty((scores.shape[1] + COUNTED - 1, len(weights)), np.uint16)
    counts = np.empty(len(weights), np.uint16)
    for row in range(len(scores)):
        top = (row + 1) * SIDE
        for column in range(len(strips)):
            strip, left = strips[column], (column + 1) * SIDE
            if row:
                for y in range(top - SIDE, top):
                    for x in range(left, left + SIDE):
                        strip[shades[y, x]] -= 1
            else:
                for shade in range(len(strip)):
                    strip[shade] = 0
            for y in range(top + (COUNTED - 1) * SIDE if row else top, top + COUNTED * SIDE):
                for x in range(left, left + SIDE):
                    strip[shades[y, x]] += 1
        # The histogram of a window is the sum of its strips.
        for shade in range(len(counts)):
            counts[shade] = 0
            for column in range(COUNTED - 1):
                counts[shade] += strips[column, shade]
        for column in range(scores.shape[1]):
            enters, leaves = strips[column + COUNTED - 1], strips[column]
            for shade in range(len(counts)):
                counts[shade] += enters[shade]
            if scores[row, column] >= threshold:
                total = float32(0)
                for shade in range(len(counts)):
                    total += weights[shade] * np.sqrt(float32(counts[shade]))
                scores[row, column] += _ROOT * total
            for shade in range(len(counts)):
                counts[shade] -= leaves[shade]


@kernel("void(float32[:,::1], uint16[:,::1], int64[:,::1], float32[:,::1])", **_OPTIONS)
def cut_rows(grid: Float32, shades: UInt16, corners: Int64, features: Float32) -> None:
    """Feature rows of the windows whose first cells are `corners`."""
    for k in range(len(corners)):
        row, column = corners[k, 0], corners[k, 1]
        for i in range(WINDOW):
            cells = grid[row + i, column * CHANNELS : (column + WINDOW) * CHANNELS]
            line = features[k, i * WINDOW * CHANNELS : (i + 1) * WINDOW * CHANNELS]
            for j in range(WINDOW * CHANNELS):
                line[j] = cells[j]
        _count_shades(shades, row, column, features[k, _CELL_FEATURES:])


@kernel("void(uint8[:,:,:,::1], int64, float32[:,:,::1], uint16[::1], float32[:,::1])", **_OPTIONS)
def describe_windows(patches: UInt8, margin: int, shares: Float32, table: UInt16, features: Float32) -> None:
    """Feature rows of patches; a patch is a window with its margin."""
    cells = np.empty((WINDOW, WINDOW, CHANNELS), np.float32)
    shades = np.empty((WINDOW * SIDE, WINDOW * SIDE), np.uint16)
    first, inner = np.zeros((1, 2), np.int64), slice(margin * CELL, (margin + WINDOW) * CELL)
    for k in range(len(patches)):
        describe_cells(patches[k], margin, shares, cells)
        look_up_shades(patches[k][:, inner, inner], table, shades)
        cut_rows(cells.reshape(WINDOW, -1), shades, first, features[k : k + 1])


@kernel("void(float32[:,::1], float32[:,::1], float32[:,::1])", **_OPTIONS)
def add_cell_scores(grid: Float32, weights: Float32, scores: Float32) -> None:
    """Add the products of each row of cells with the rows of all windows that contain it."""
    for row in range(len(grid)):
        for column in range(scores.shape[1]):
            cells = grid[row, column * CHANNELS : (column + WINDOW) * CHANNELS]
            for i in range(max(row - len(scores) + 1, 0), min(row + 1, WINDOW)):
                line, total = weights[i], float32(0)
                for j in range(WINDOW * CHANNELS):
                    total += cells[j] * line[j]
                scores[row - i, column] += total
