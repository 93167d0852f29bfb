"""Vectors of a descriptor around an object, computed once per frame and sampled for all windows there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from catstream.base.box import Window
from catstream.features import kernels
from catstream.features.descriptor import Descriptor
from catstream.features.layout import CELL, EDGE, PLACES, STRIDE, WINDOW

_WEIGHT = np.float32(WINDOW / PLACES)  # one vector stands for 2 x 2 cells, each of which varies as much as it


@dataclass(frozen=True, slots=True, eq=False)
class VectorMap:
    """Vectors of a descriptor around a window, between which others are interpolated.

    A cubic B-spline smooths the vectors by nearly the same amount wherever it is evaluated. Linear interpolation would
    smooth most in the middle between two vectors, which would distinguish the object's own window from all others.

    vectors  float32 (rows, columns, channels); a window is 4 x 4 of them
    window   lies in their middle
    """

    vectors: np.ndarray
    window: Window

    @classmethod
    def of(cls, descriptor: Descriptor, planes: np.ndarray, window: Window) -> Self:
        """The vectors of an image, uint8 (3, h, w), with a window of 64 x 64 pixels in its middle."""
        return cls(descriptor(planes) * _WEIGHT, window)

    def grid(self, window: Window, side: int, turn: float = 0.0) -> np.ndarray:
        """Vectors where four cells meet, of `side` x `side` cells around another window, rotated by `turn` radians.

        Returns float32 (side - 1, side - 1, channels); a window has every second of them.
        """
        rows, columns, channels = self.vectors.shape
        output = np.empty((side - 1, side - 1, channels), np.float32)
        (x, y), (middle_x, middle_y) = window.centre, self.window.centre
        step_x, step_y = self.window.w / PLACES, self.window.h / PLACES  # of the vectors, in pixels of the frame
        w, h, cos, sin = window.w / WINDOW, window.h / WINDOW, math.cos(turn), math.sin(turn)
        right, below = (w * cos / step_x, w * sin / step_y), (-h * sin / step_x, h * cos / step_y)
        left = (columns - 1 - (side - 2) * (right[0] + below[0])) / 2 + (x - middle_x) / step_x
        top = (rows - 1 - (side - 2) * (right[1] + below[1])) / 2 + (y - middle_y) / step_y
        kernels.sample_vectors(self.vectors, np.array([(left, top), right, below]), output)
        return output

    @staticmethod
    def between_cells(descriptor: Descriptor, planes: np.ndarray) -> np.ndarray:
        """Vectors where four cells meet, of all cells of an image, uint8 (3, h, w).

        Returns float32 (h / 8 - 1, w / 8 - 1, channels).
        """
        _, height, width = planes.shape
        edge = EDGE * CELL
        sides = (edge, edge + -height % STRIDE), (edge, edge + -width % STRIDE)
        vectors = descriptor(np.pad(planes, ((0, 0), *sides), "edge")) * _WEIGHT
        output = np.empty((height // CELL - 1, width // CELL - 1, descriptor.channels), np.float32)
        first, half = edge / STRIDE, CELL / STRIDE
        kernels.sample_vectors(vectors, np.array([(first, first), (half, 0.0), (0.0, half)]), output)
        return output

    def row(self, window: Window, turn: float = 0.0) -> np.ndarray:
        """The 4 x 4 vectors of a window that is rotated by `turn` radians, float32 (16 * channels,)."""
        features: np.ndarray = self.grid(window, WINDOW, turn)[::2, ::2].ravel()
        return features
