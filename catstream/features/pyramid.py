"""The image pyramid of a frame: patches of a large object are cut from a shared smaller copy."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from catstream.base.box import Window
from catstream.features.layout import CELL, MARGIN, WINDOW
from catstream.features.sampling import average, sample

_MAX_CELLS = 62_500  # in the region around a small window: bounds the cost of a large frame
_OVERLAP = WINDOW + 2 * MARGIN  # minimum overlap of adjacent parts of a region, in cells: a window and its margin


class Region(NamedTuple):
    """A rectangle of whole pixels of a frame."""

    left: int
    top: int
    width: int
    height: int

    def cells(self, window: Window) -> float:
        """Number of cells of the region if a window in it has 8 x 8."""
        return (self.width / window.w * WINDOW) * (self.height / window.h * WINDOW)

    def split(self, window: Window, max_cells: int) -> list[Region]:
        """Split into parts of at most `max_cells` cells, up to rounding; every window lies in a part, with its margin.

        >>> Region(0, 0, 640, 480).split(Window(0, 0, 64, 64), 5000)
        [Region(left=0, top=0, width=640, height=480)]
        >>> Region(0, 0, 640, 480).split(Window(0, 0, 64, 64), 4000)
        [Region(left=0, top=0, width=368, height=480), Region(left=272, top=0, width=368, height=480)]
        """
        share_x, share_y = window.w / WINDOW * _OVERLAP, window.h / WINDOW * _OVERLAP
        across = down = 1
        width, height = float(self.width), float(self.height)
        while width / window.w * height / window.h * WINDOW**2 > max_cells:
            if width / window.w >= height / window.h:
                across += 1
                width = (self.width + (across - 1) * share_x) / across
            else:
                down += 1
                height = (self.height + (down - 1) * share_y) / down
        w, h = min(math.ceil(width), self.width), min(math.ceil(height), self.height)
        lefts = [self.left + round(i * (self.width - w) / max(across - 1, 1)) for i in range(across)]
        tops = [self.top + round(i * (self.height - h) / max(down - 1, 1)) for i in range(down)]
        return [Region(left, top, w, h) for top in tops for left in lefts]


class Pyramid:
    """A frame at full, half, quarter ... size; the levels are computed at their first use.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR, or (h, w) grey; patches have the same channels
    """

    def __init__(self, image: np.ndarray) -> None:
        self.image = np.ascontiguousarray(image)
        self._halves = {0: self.image}

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frame in pixels."""
        height, width = self.image.shape[:2]
        return width, height

    def near(self, scale: float) -> tuple[np.ndarray, int]:
        """The smallest level whose pixels are at most `scale` pixels of the frame wide, and their width: 1, 2, 4 ...

        So linear interpolation skips few pixels of the frame, if any. An odd last row or column is dropped.

        >>> image, wide = Pyramid(np.zeros((90, 121, 3), np.uint8)).near(5.9)
        >>> image.shape, wide
        ((22, 30, 3), 4)
        """
        level = 0
        while 2 << level <= scale and min(self._halves[level].shape[:2]) > 1:
            level += 1
            if level not in self._halves:
                larger = self._halves[level - 1]
                height, width = larger.shape[0] // 2, larger.shape[1] // 2
                half = cv2.resize(larger[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
                self._halves[level] = half
        return self._halves[level], 1 << level

    def around(self, window: Window, side: int) -> np.ndarray:
        """Cut `side` x `side` cells and a margin around a window, which then has 64 x 64 pixels: see `cut`."""
        x, y = window.centre
        step_x, step_y = window.w / WINDOW, window.h / WINDOW
        return self.cut(x, y, step_x / CELL, step_y / CELL, (side + 2 * MARGIN) * CELL)

    @property
    def region(self) -> Region:
        """All of the frame."""
        return Region(0, 0, *self.size)

    def region_around(self, window: Window) -> Region:
        """All of the frame, or, if that has more than 62,500 cells, a part around the window with that many."""
        width, height = self.size
        reach = math.sqrt(_MAX_CELLS / self.region.cells(window))
        if reach >= 1:
            return self.region
        x, y = window.centre
        w, h = int(width * reach), int(height * reach)
        return Region(int(np.clip(x - w / 2, 0, width - w)), int(np.clip(y - h / 2, 0, height - h)), w, h)

    def part(self, region: Region) -> Pyramid:
        """A region of the frame; the pyramid itself, if the region is all of it."""
        if region == self.region:
            return self
        return Pyramid(self.image[region.top :, region.left :][: region.height, : region.width])

    def resized(self, window: Window, *, averaged: bool = True) -> tuple[np.ndarray, tuple[float, float]]:
        """Resize the frame so that a window is 64 x 64 pixels; also returns the size of a cell in pixels of the frame.

        Only the size of the window matters. If `averaged`, a frame is reduced by averaging its pixels; otherwise by
        interpolation as in `cut`, in half of the time.
        """
        width, height = self.size
        columns = max(WINDOW, round(width / window.w * WINDOW))
        rows = max(WINDOW, round(height / window.h * WINDOW))
        size = (columns * CELL, rows * CELL)
        scale = min(width / size[0], height / size[1])
        image, wide = self.near(scale)
        resized = reduced(image, size) if averaged and scale > 1 else cv2.resize(image, size)
        return resized, (image.shape[1] * wide / columns, image.shape[0] * wide / rows)

    def cut(self, x: float, y: float, across: float, down: float, size: int, angle: float = 0.0) -> np.ndarray:
        """Cut a square of `size` pixels, centred at (x, y) and rotated by `angle` radians; the border is replicated.

        A pixel of the patch is `across` pixels of the frame wide and `down` high. Returns uint8 (3, size, size), blue,
        green and red, or (1, size, size) of a grey frame.
        """
        image, wide = self.near(min(across, down))
        x, y, across, down = x / wide - 0.5, y / wide - 0.5, across / wide, down / wide
        middle = (size - 1) / 2
        if not angle:
            patch = np.empty((1 if image.ndim == 2 else 3, size, size), np.uint8)
            lines = image.reshape(len(image), -1)
            sample(lines, x - middle * across, y - middle * down, across, down, patch)
            return patch
        cos, sin = math.cos(angle), math.sin(angle)
        right, below = (across * cos, across * sin), (-down * sin, down * cos)
        corner = x - (right[0] + below[0]) * middle, y - (right[1] + below[1]) * middle
        matrix = np.array([right, below, corner]).T
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return planes_of(cv2.warpAffine(image, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def planes_of(image: np.ndarray) -> np.ndarray:
    """The planes of an image, uint8 (h, w, 3) or (h, w), as uint8 (3, h, w) or (1, h, w)."""
    if image.ndim == 2:
        return image[None]
    planes = np.empty((3, *image.shape[:2]), np.uint8)
    cv2.split(image, list(planes))
    return planes


def reduced(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Reduce an image to (width, height): a pixel is the mean of the pixels it covers, as with `cv2.INTER_AREA`."""
    across, down = 1 / (size[0] / image.shape[1]), 1 / (size[1] / image.shape[0])
    if image.ndim == 2 or min(across, down) < 1 or (across.is_integer() and down.is_integer()):
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    output = np.empty((size[1], size[0], 3), np.uint8)
    average(image, across, down, output)
    return output
