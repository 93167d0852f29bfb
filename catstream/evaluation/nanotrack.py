"""NanoTrackV3, a small trained tracker. OpenCV's `TrackerNano` reads the files of version 2 only."""

from __future__ import annotations

import cv2
import numpy as np

from catstream.base.arrays import Float32, Float64, UInt8

_TEMPLATE, _REGION = 127, 255  # sides of what the network sees of the first frame and of each other one, pixels
_STRIDE, _PLACES = 16, 15  # of the places at which it detects the object
_CHANGE, _DISTANCE, _RATE = 0.138, 0.455, 0.348  # its author's: penalties of a new size and of a move, rate of sizes
_LEAST = 10.0  # width and height of a box, pixels


class NanoTrackV3:
    """NanoTrackV3, from github.com/HonglinChu/SiamTrackers, with the interface of `cv2.TrackerNano`."""

    def __init__(self, parameters: cv2.TrackerNano.Params) -> None:
        self._backbone = cv2.dnn.readNet(parameters.backbone)
        self._head = cv2.dnn.readNet(parameters.neckhead)
        hanning = np.hanning(_PLACES)
        self._window = np.outer(hanning, hanning)
        self._offsets = (np.arange(_PLACES) - _PLACES // 2) * _STRIDE
        self._score = 0.0

    def init(self, frame: UInt8, box: tuple[int, int, int, int]) -> None:
        x, y, w, h = box
        self._center, self._size = np.array([x + (w - 1) / 2, y + (h - 1) / 2]), np.array([w, h], float)
        self._border = frame.mean(axis=(0, 1))
        self._template = self._features(frame, _TEMPLATE)

    def update(self, frame: UInt8) -> tuple[bool, tuple[float, ...]]:
        """Move the box to the place with the highest score, less the penalties, and its size a part of the way."""
        scale = _TEMPLATE / _extent(*self._size)
        self._head.setInput(self._template, "input1")
        self._head.setInput(self._features(frame, _REGION), "input2")
        logits, sides = (output[0].astype(float) for output in self._head.forward(["output1", "output2"]))
        scores = 1 / (1 + np.exp(logits[0] - logits[1]))
        left, top, right, bottom = sides  # distances from the place to the sides of the box
        width, height = left + right, top + bottom
        expected = self._size * scale
        size = _ratio(_extent(width, height) / _extent(*expected))
        aspect = _ratio(width / height / (expected[0] / expected[1]))
        penalty = np.exp(-(size * aspect - 1) * _CHANGE)
        ranks = penalty * scores * (1 - _DISTANCE) + self._window * _DISTANCE
        row, column = np.unravel_index(np.argmax(ranks), ranks.shape)
        best = row, column
        self._score = float(scores[best])
        move = self._offsets[[column, row]] + [right[best] - left[best], bottom[best] - top[best]] / np.array(2)
        rate = penalty[best] * scores[best] * _RATE
        limits = np.array(frame.shape[1::-1], float)
        self._center = (self._center + move / scale).clip(0, limits)
        detected = np.array([width[best], height[best]]) / scale
        self._size = (self._size * (1 - rate) + detected * rate).clip(_LEAST, np.maximum(limits, _LEAST))
        return True, (*(self._center - self._size / 2), *self._size)

    def getTrackingScore(self) -> float:
        return self._score

    def _features(self, frame: UInt8, side: int) -> Float32:
        """Return the features of a square around the box, in which the box is as large as in the template."""
        length = round(float(_extent(*self._size)) * side / _TEMPLATE)
        step = length / side
        x, y = np.floor(self._center - length / 2) + (step - 1) / 2
        matrix = np.array([[step, 0, x], [0, step, y]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        square = cv2.warpAffine(frame, matrix, (side, side), flags=flags, borderValue=self._border.tolist())
        self._backbone.setInput(cv2.dnn.blobFromImage(square))
        features: Float32 = np.asarray(self._backbone.forward(), np.float32)
        return features


def _extent(width: Float64, height: Float64) -> Float64:
    """Return the side of a square with the area of a box and its surroundings."""
    around = (width + height) / 2
    return np.asarray(((width + around) * (height + around)) ** 0.5)


def _ratio(values: Float64) -> Float64:
    """Return each value or its reciprocal, whichever is above 1."""
    return np.maximum(values, 1 / values)
