"""Kernels: loops over pixels and cells, compiled by numba when this module is imported, and cached from then on.

numba's cache is invalidated by changes of this file only. So all kernels are here, with the functions that they call
and the constants that they read; `catstream.features.layout` repeats some of these constants, and a test compares them.

A kernel writes into an output array of its caller. Arithmetic may be reordered, except in `average`, and neither bounds
nor divisions by 0 are checked. A call releases the GIL. An array of another type than in the signature, or a read-only
one, is a TypeError.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np
from numpy import float32

from catstream.base.arrays import Float32, Float64, Int64, UInt8, UInt16, UInt32
from catstream.errors import ServiceError

try:
    import numba
    from numba.core import event
except PermissionError:
    raise ServiceError(
        "kernels cannot be compiled, as this process may not make memory executable: allow it, in a unit of systemd "
        "with MemoryDenyWriteExecute=no"
    ) from None

#: Logged at the first start after an installation, before the kernels are compiled.
COMPILING = "compiling kernels, once: about 8 s"

CELL, WINDOW, CHANNELS, SIDE = 8, 8, 34, 4  # as in layout.py
_PLACES = WINDOW * WINDOW * CHANNELS  # features of the cells of a window, before those of its colours

_Function = TypeVar("_Function", bound=Callable[..., Any])

_log = logging.getLogger(__name__)
_options: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}
_part: Callable[[_Function], _Function] = numba.njit(**_options)  # a function that kernels call
_ordered: Callable[[_Function], _Function] = numba.njit(**_options | {"fastmath": False})


def _kernel(signature: str, **changes: bool) -> Callable[[_Function], _Function]:
    """Compile a function for these types, or load its machine code from the cache.

    The cache is the folder NUMBA_CACHE_DIR, or else `__pycache__` beside this file, or else the user's cache folder. If
    none of them can be written, or a file in it is damaged, every start compiles. `changes` are changed options.
    """
    options = _options | changes

    def compiled(function: _Function) -> _Function:
        with event.install_listener("numba:compile", _Announcement()):
            try:
                kernel = numba.njit(signature, cache=True, **options)(function)
            except Exception:  # of the cache: there is no folder, its disk is full, a file is damaged
                kernel = numba.njit(signature, **options)(function)
        return cast(_Function, kernel)

    return compiled


class _Announcement(event.Listener):
    """Logs `COMPILING` before the first kernel that is compiled."""

    def on_start(self, _: event.Event) -> None:
        _announce()

    def on_end(self, _: event.Event) -> None:
        pass


@cache
def _announce() -> None:
    _log.warning(COMPILING)


_ORIENTATIONS = 9
_SIGNED = 2 * _ORIENTATIONS
_HALF = CELL // 2
_CLIP = float32(0.2)  # upper limit of a normalised bin (Dalal and Triggs 2005)
_TEXTURE = float32(0.2357)  # 1 / sqrt(18), as published
_COLOUR_WEIGHT = 1.5
_LIGHT_SCALE = float32(_COLOUR_WEIGHT / 255)
_CHROMA_SCALE = float32(3) * _LIGHT_SCALE
_LAB_MIDDLE = 128
#: Orientations are 20 degrees apart: the tangents of where one ends and the next begins, from 0 to 90.
_TAN_10, _TAN_30, _TAN_50, _TAN_70 = np.tan(np.deg2rad([10, 30, 50, 70])).astype(np.float32)

COLOUR_LENGTH = 3.0  #: length of a histogram of colours as features; that of a window's HOG is about 9
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


@_part
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


@_kernel("void(uint8[:,::1], uint8[:,::1])")
def convert_to_lab(colours: UInt8, lab: UInt8) -> None:
    """Lab of colours, (k, 3): blue, green, red to lightness, a, b, as OpenCV's `COLOR_BGR2LAB` converts them.

    OpenCV makes tables first, for 90 ms in each process, which differ in a few entries between processors. The tables
    here do not: a few colours in ten thousand differ by one level.
    """
    for k in range(len(colours)):
        lab[k, 0], lab[k, 1], lab[k, 2] = _lab(colours[k, 0], colours[k, 1], colours[k, 2])


@_part
def _read(planes: UInt8, y: int, line: Float32) -> None:
    """The three channels of one row of pixels, the pixels at the edge twice."""
    width = line.shape[1] - 2
    for channel in range(3):
        values, row = line[channel], planes[channel, y]
        for x in range(width):
            values[x + 1] = row[x]
        values[0], values[width + 1] = values[1], values[width]


@_part
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


@_part
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


@_part
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


@_part
def _count(planes: UInt8, margin: int, shares: Float32, histogram: Float32) -> None:
    """Histograms of the cells within a margin."""
    rows, columns = histogram.shape[0] - 2, histogram.shape[1] - 2
    height, width = rows * CELL, columns * CELL
    lines = np.empty((3, 3, width + 2), np.float32)  # the channels of the rows above, here and below, in turns
    across, down = np.empty(width, np.float32), np.empty(width, np.float32)
    magnitude = np.empty(width + CELL, np.float32)  # with half a cell more on either side
    orientation = np.empty(width + CELL, np.uint8)
    blocks = np.empty((columns + 1, _SIGNED, 4), np.float32)  # of the pixels between the centres of four cells
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
            _gradients(above, here, below, across, down, magnitude[_HALF : _HALF + width])
            _orientations(across, down, orientation[_HALF : _HALF + width])
            line = shares[(y + _HALF) % CELL]
            _add(magnitude[inner], orientation[inner], line, blocks[margin : columns + 1 - margin])
        for block in range(margin, columns + 1 - margin):
            for o in range(_SIGNED):
                histogram[band, block, o] += blocks[block, o, 0]
                histogram[band, block + 1, o] += blocks[block, o, 1]
                histogram[band + 1, block, o] += blocks[block, o, 2]
                histogram[band + 1, block + 1, o] += blocks[block, o, 3]


@_part
def _average(plane: UInt8, row: int, column: int) -> int:
    """The mean of one channel of a cell's pixels."""
    total = float32(CELL * CELL // 2)  # half, to round; floats are added eight at once
    for y in range(row * CELL, (row + 1) * CELL):
        for x in range(column * CELL, (column + 1) * CELL):
            total += float32(plane[y, x])
    return int(total) // (CELL * CELL)


@_part
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


@_part
def _normalise(histogram: Float32, margin: int, cells: Float32) -> None:
    """Each cell's histogram by the energies of the four blocks of 2 x 2 cells that it is in."""
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


@_kernel("void(uint8[:,:,::1], int64, float32[:,:,::1], float32[:,:,::1])")
def describe_cells(planes: UInt8, margin: int, shares: Float32, cells: Float32) -> None:
    """HOG and mean colour of the cells within the margin.

    It goes line by line: what a line's pixels do is written so that the compiler does eight of them at once. Only
    counting them is one by one, but each pixel is added to its four nearest cells at once.
    """
    rows, columns = cells.shape[0] + 2 * margin, cells.shape[1] + 2 * margin
    histogram = np.empty((rows + 2, columns + 2, _SIGNED), np.float32)  # one more on every side: what falls outside
    _count(planes, max(margin - 1, 0), shares, histogram)
    _normalise(histogram, margin, cells)
    _colour(planes, margin, cells)


@_kernel("void(uint8[:,:,:], uint16[::1], uint16[:,::1])")
def look_up_shades(planes: UInt8, table: UInt16, shades: UInt16) -> None:
    """The shade of every 2 x 2 pixels of the planes blue, green and red, by a table of BGR colours of 5 bits each."""
    for y in range(shades.shape[0]):
        for x in range(shades.shape[1]):
            place = 0  # the first 5 bits of each channel's mean, one after the other
            for channel in range(3):
                above = np.int64(planes[channel, 2 * y, 2 * x]) + planes[channel, 2 * y, 2 * x + 1]
                below = np.int64(planes[channel, 2 * y + 1, 2 * x]) + planes[channel, 2 * y + 1, 2 * x + 1]
                mean = (above + below + 2) >> 2
                place = place << 5 | mean >> 3
            shades[y, x] = table[place]


@_part
def _count_shades(shades: UInt16, row: int, column: int, features: Float32) -> None:
    """Features of the window whose first cell is (row, column), into float32 (SHADES,)."""
    for shade in range(len(features)):
        features[shade] = 0
    for y in range((row + 1) * SIDE, (row + 1 + COUNTED) * SIDE):
        for x in range((column + 1) * SIDE, (column + 1 + COUNTED) * SIDE):
            features[shades[y, x]] += 1
    for shade in range(len(features)):
        features[shade] = _ROOT * np.sqrt(features[shade])


@_kernel("void(uint16[:,::1], float32[::1], float32, float32[:,::1])")
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


@_kernel("void(float32[:,::1], uint16[:,::1], int64[:,::1], float32[:,::1])")
def cut_rows(grid: Float32, shades: UInt16, places: Int64, features: Float32) -> None:
    """Feature rows of the windows whose first cells are at `places`."""
    for k in range(len(places)):
        row, column = places[k, 0], places[k, 1]
        for i in range(WINDOW):
            cells = grid[row + i, column * CHANNELS : (column + WINDOW) * CHANNELS]
            line = features[k, i * WINDOW * CHANNELS : (i + 1) * WINDOW * CHANNELS]
            for j in range(WINDOW * CHANNELS):
                line[j] = cells[j]
        _count_shades(shades, row, column, features[k, _PLACES:])


@_kernel("void(uint8[:,:,:,::1], int64, float32[:,:,::1], uint16[::1], float32[:,::1])")
def describe_windows(patches: UInt8, margin: int, shares: Float32, table: UInt16, features: Float32) -> None:
    """Feature rows of patches, each of which is a window and its margin."""
    cells = np.empty((WINDOW, WINDOW, CHANNELS), np.float32)
    shades = np.empty((WINDOW * SIDE, WINDOW * SIDE), np.uint16)
    first, inner = np.zeros((1, 2), np.int64), slice(margin * CELL, (margin + WINDOW) * CELL)
    for k in range(len(patches)):
        describe_cells(patches[k], margin, shares, cells)
        look_up_shades(patches[k][:, inner, inner], table, shades)
        cut_rows(cells.reshape(WINDOW, -1), shades, first, features[k : k + 1])


@_kernel("void(float32[:,::1], float32[:,::1], float32[:,::1])")
def add_cell_scores(grid: Float32, weights: Float32, scores: Float32) -> None:
    """Add the products of each row of cells, (34 columns,), with each row of the windows that it lies in."""
    for row in range(len(grid)):
        for column in range(scores.shape[1]):
            cells = grid[row, column * CHANNELS : (column + WINDOW) * CHANNELS]
            for i in range(max(row - len(scores) + 1, 0), min(row + 1, WINDOW)):
                line, total = weights[i], float32(0)
                for j in range(WINDOW * CHANNELS):
                    total += cells[j] * line[j]
                scores[row - i, column] += total


@_kernel("void(uint8[:,::1], float64, float64, float64, float64, uint8[:,:,::1])")
def sample(image: UInt8, left: float, top: float, across: float, down: float, output: UInt8) -> None:
    """Linear interpolation at left, left + across ... and top, top + down ...: between rows first, then in the row."""
    channels, rows, columns = output.shape
    height, width = image.shape[0], image.shape[1] // channels
    begin = min(max(int(np.floor(left)), 0), width - 1)
    end = min(max(int(np.floor(left + (columns - 1) * across)) + 2, begin + 1), width)
    line = np.empty(image.shape[1], np.float32)
    # For every output pixel: the indices in the line of its two neighbours, and the weight of the second one.
    first, second, share = np.empty(columns, np.uint32), np.empty(columns, np.uint32), np.empty(columns, np.float32)
    for i in range(columns):
        x = left + i * across
        pixel = int(np.floor(x))
        first[i] = (min(max(pixel, begin), end - 1) - begin) * channels
        second[i] = (min(max(pixel + 1, begin), end - 1) - begin) * channels
        share[i] = x - np.floor(x)
    for row in range(rows):
        y = top + row * down
        pixel = int(np.floor(y))
        above = image[min(max(pixel, 0), height - 1), begin * channels : end * channels]
        below = image[min(max(pixel + 1, 0), height - 1), begin * channels : end * channels]
        part = float32(y - np.floor(y))
        for i in range((end - begin) * channels):
            value = float32(above[i])
            line[i] = value + part * (float32(below[i]) - value) + float32(0.5)  # half, to round
        for channel in range(channels):
            values, output_line = line[channel:], output[channel, row]
            for i in range(columns):
                value = values[first[i]]
                output_line[i] = np.uint8(value + share[i] * (values[second[i]] - value))


@_ordered
def _taps(scale: float, size: int, pixels: UInt32, shares: Float32) -> None:
    """The pixels of an axis of `size` pixels that each output pixel covers, `scale` of them; and their shares of it."""
    for i in range(pixels.shape[1]):
        begin, count = i * scale, 0
        end = begin + scale
        covered = min(scale, size - begin)
        last = min(int(np.floor(end)), size - 1)
        first = min(int(np.ceil(begin)), last)
        if first - begin > 1e-3:
            pixels[count, i], shares[count, i] = first - 1, (first - begin) / covered
            count += 1
        for pixel in range(first, last):
            pixels[count, i], shares[count, i] = pixel, 1 / covered
            count += 1
        if end - last > 1e-3:
            pixels[count, i], shares[count, i] = last, min(end - last, 1.0, covered) / covered


@_kernel("void(uint8[:,:,::1], float64, float64, uint8[:,:,::1])", fastmath=False)
def average(image: UInt8, across: float, down: float, output: UInt8) -> None:
    """Reduce an image of three channels: the mean of the `across` x `down` pixels that an output pixel covers.

    The pixels equal `cv2.INTER_AREA`, which takes twice as long.
    """
    rows, columns = output.shape[:2]
    below, right = max(3, int(np.ceil(down)) + 1), max(3, int(np.ceil(across)) + 1)
    lines, parts = np.zeros((below, rows), np.uint32), np.zeros((below, rows), np.float32)
    places, shares = np.zeros((right, columns), np.uint32), np.zeros((right, columns), np.float32)
    _taps(down, image.shape[0], lines, parts)
    _taps(across, image.shape[1], places, shares)
    places *= np.uint32(3)
    line = np.empty(3 * image.shape[1], np.float32)
    reduced, total = np.empty(3 * columns, np.float32), np.empty(3 * columns, np.float32)
    ready = -1
    for row in range(rows):
        for tap in range(below):
            part = parts[tap, row]
            if part == 0:
                break
            if lines[tap, row] != ready:  # two output rows may cover the same one
                ready = lines[tap, row]
                values = image[ready].reshape(-1)
                for i in range(len(line)):
                    line[i] = values[i]
                for i in range(columns):
                    blue, green, red = float32(0), float32(0), float32(0)
                    for k in range(3):  # unrolled: mostly there are no more
                        place, share = places[k, i], shares[k, i]
                        blue += line[place] * share
                        green += line[place + 1] * share
                        red += line[place + 2] * share
                    for k in range(3, right):
                        place, share = places[k, i], shares[k, i]
                        blue += line[place] * share
                        green += line[place + 1] * share
                        red += line[place + 2] * share
                    reduced[3 * i], reduced[3 * i + 1], reduced[3 * i + 2] = blue, green, red
            if tap == 0:
                total[:] = 0
            for i in range(len(total)):
                total[i] += part * reduced[i]
        pixels = output[row].reshape(-1)
        for i in range(len(total)):
            pixels[i] = np.uint8(np.rint(total[i]))


@_kernel("void(float64[:,::1], float64[:,::1], float32[:,::1])")
def sparse_codes(gains: Float64, gram: Float64, codes: Float32) -> None:
    """Non-negative sparse codes, by active sets (Lawson and Hanson).

    The atom with the highest gain enters the active set; atoms whose code becomes negative leave it.

    `gains` are those at code 0. The Gram matrix of the set is stored as a Cholesky factor with an inverted diagonal,
    with the solution of its forward substitution: an atom that enters adds one row to both.
    """
    count = len(gram)
    code, solution, forward, gain = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    active, factor = np.empty(count, np.int64), np.empty((count, count))
    for row in range(len(codes)):
        start, size = gains[row], 0
        for atom in range(count):
            gain[atom] = start[atom]
        for _ in range(3 * count):
            highest, best = gain[0], 0
            for atom in range(1, count):
                highest = max(highest, gain[atom])
            if highest <= 1e-6:
                break
            while gain[best] < highest:
                best += 1
            active[size], code[size] = best, 0.0
            valid, size = size, size + 1
            while size:
                for i in range(valid, size):
                    alike = gram[active[i]]
                    for j in range(i):
                        total = alike[active[j]]
                        for k in range(j):
                            total -= factor[i, k] * factor[j, k]
                        factor[i, j] = total * factor[j, j]
                    total, ahead = alike[active[i]], start[active[i]]
                    for k in range(i):
                        total -= factor[i, k] * factor[i, k]
                        ahead -= factor[i, k] * forward[k]
                    factor[i, i] = 1 / np.sqrt(max(total, 1e-9))
                    forward[i] = ahead * factor[i, i]
                for i in range(size):
                    solution[i] = forward[i]
                for i in range(size - 1, -1, -1):
                    solution[i] *= factor[i, i]
                    for k in range(i):
                        solution[k] -= factor[i, k] * solution[i]
                way, out = 1.0, -1
                for i in range(size):
                    if solution[i] <= 0:
                        now = code[i]
                        part = now / (now - solution[i]) if now > 0 else 0.0
                        if part < way:
                            way, out = part, i
                for i in range(size):
                    code[i] += way * (solution[i] - code[i])
                if out < 0:
                    break
                size -= 1
                for i in range(out, size):
                    active[i], code[i] = active[i + 1], code[i + 1]
                valid = out
            for atom in range(count):
                gain[atom] = start[atom]
            for i in range(size):
                weight, alike = code[i], gram[active[i]]
                for atom in range(count):
                    gain[atom] -= weight * alike[atom]
            for i in range(size):
                gain[active[i]] = 0
        for i in range(size):
            codes[row, active[i]] = code[i]
