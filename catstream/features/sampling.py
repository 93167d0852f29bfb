"""Kernels that resample images: linear interpolation, and the mean of the pixels that a pixel covers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import float32

from catstream.base.arrays import Float32, UInt8, UInt32
from catstream.features.compilation import function, kernel

_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}
_ORDERED = _OPTIONS | {"fastmath": False}  # sums in the order of OpenCV, for the same bits


@kernel("void(uint8[:,::1], float64, float64, float64, float64, uint8[:,:,::1])", **_OPTIONS)
def sample(image: UInt8, left: float, top: float, across: float, down: float, output: UInt8) -> None:
    """Linear interpolation at left, left + across ... and top, top + down ...: between rows first, then in the row."""
    channels, rows, columns = output.shape
    height, width = image.shape[0], image.shape[1] // channels
    begin = min(max(int(np.floor(left)), 0), width - 1)
    end = min(max(int(np.floor(left + (columns - 1) * across)) + 2, begin + 1), width)
    line = np.empty(image.shape[1], np.float32)
    # Step 1: for each output column, the indices of its two neighbours, and the weight of the second one.
    first, second, share = np.empty(columns, np.uint32), np.empty(columns, np.uint32), np.empty(columns, np.float32)
    for i in range(columns):
        x = left + i * across
        pixel = int(np.floor(x))
        first[i] = (min(max(pixel, begin), end - 1) - begin) * channels
        second[i] = (min(max(pixel + 1, begin), end - 1) - begin) * channels
        share[i] = x - np.floor(x)
    # Step 2: for each output row, interpolate between two rows, then within the line.
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


@function(**_ORDERED)
def _taps(scale: float, size: int, pixels: UInt32, shares: Float32) -> None:
    """The pixels along an axis of `size` pixels that an output pixel, `scale` wide, covers; and their shares."""
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


@kernel("void(uint8[:,:,::1], float64, float64, uint8[:,:,::1])", **_ORDERED)
def average(image: UInt8, across: float, down: float, output: UInt8) -> None:
    """Reduce an image of three channels: the mean of the `across` x `down` pixels that an output pixel covers.

    The pixels equal `cv2.INTER_AREA`, which takes twice as long.
    """
    # Step 1: the pixels that each output row and column covers.
    rows, columns = output.shape[:2]
    below, right = max(3, int(np.ceil(down)) + 1), max(3, int(np.ceil(across)) + 1)
    lines, parts = np.zeros((below, rows), np.uint32), np.zeros((below, rows), np.float32)
    pixels, shares = np.zeros((right, columns), np.uint32), np.zeros((right, columns), np.float32)
    _taps(down, image.shape[0], lines, parts)
    _taps(across, image.shape[1], pixels, shares)
    pixels *= np.uint32(3)  # to indices of a line
    line = np.empty(3 * image.shape[1], np.float32)
    reduced, total = np.empty(3 * columns, np.float32), np.empty(3 * columns, np.float32)
    # Step 2: reduce the covered lines along the row, and add them up by their shares.
    ready = -1  # the input line that was reduced last
    for row in range(rows):
        for tap in range(below):
            part = parts[tap, row]
            if part == 0:
                break
            if lines[tap, row] != ready:  # two output rows may cover the same line
                ready = lines[tap, row]
                values = image[ready].reshape(-1)
                for i in range(len(line)):
                    line[i] = values[i]
                for i in range(columns):
                    blue, green, red = float32(0), float32(0), float32(0)
                    for k in range(3):  # unrolled: usually, there are no more
                        pixel, share = pixels[k, i], shares[k, i]
                        blue += line[pixel] * share
                        green += line[pixel + 1] * share
                        red += line[pixel + 2] * share
                    for k in range(3, right):
                        pixel, share = pixels[k, i], shares[k, i]
                        blue += line[pixel] * share
                        green += line[pixel + 1] * share
                        red += line[pixel + 2] * share
                    reduced[3 * i], reduced[3 * i + 1], reduced[3 * i + 2] = blue, green, red
            if tap == 0:
                total[:] = 0
            for i in range(len(total)):
                total[i] += part * reduced[i]
        output_line = output[row].reshape(-1)
        for i in range(len(total)):
            output_line[i] = np.uint8(np.rint(total[i]))
