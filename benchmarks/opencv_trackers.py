"""OpenCV's trackers, and NanoTrackV3, with the interface of `catstream.Tracker`, to evaluate them on the same frames.

MIL comes with every OpenCV; CSRT, KCF and TLD with the contrib modules of
OpenCV 4: `pip install ".[peers]"`. NanoTrack and VitTrack are trained
networks: they need model files, which the user has to give.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from catstream.base.arrays import Float32, Float64, UInt8
from catstream.base.box import Box
from catstream.errors import BoxError, SettingsError, install_command

#: Name on the command line -> class in OpenCV.
PEERS = {
    "csrt": "TrackerCSRT",
    "kcf": "TrackerKCF",
    "mil": "TrackerMIL",
    "tld": "TrackerTLD",
    "nano": "TrackerNano",
    "nano-v3": "TrackerNano",  # its parameters; the tracker is NanoTrackV3
    "vit": "TrackerVit",
}

#: The model files of a tracker, with the names of their authors, by parameter of its class in OpenCV.
MODELS = {
    "nano": {"backbone": "nanotrack_backbone_sim.onnx", "neckhead": "nanotrack_head_sim.onnx"},
    "nano-v3": {"backbone": "nanotrack_backbone.onnx", "neckhead": "nanotrack_head.onnx"},
    "vit": {"net": "object_tracking_vittrack_2023sep.onnx"},
}

# Of NanoTrackV3
_TEMPLATE, _REGION = 127, 255  # sides of what the network sees of the first frame and of each other one, pixels
_STRIDE, _PLACES = 16, 15  # of the places at which it detects the object
_CHANGE, _DISTANCE, _RATE = 0.138, 0.455, 0.348  # its author's: penalties of a new size and of a move, rate of sizes
_LEAST = 10.0  # width and height of a box, pixels


class Peer:
    """One of OpenCV's trackers.

    name    one of `PEERS`
    models  folder of the files in `MODELS`
    """

    def __init__(self, name: str, models: Path | None = None) -> None:
        self._create = _constructor(name, models)
        self._tracker = self._create()  # so that unreadable model files are noticed before the first frame

    def init(self, frame: np.ndarray, box: Sequence[float]) -> None:
        """Start with a box x, y, w, h in pixels. It is rounded and clipped to the frame, as OpenCV needs it."""
        height, width = frame.shape[:2]
        Box(*map(float, box)).validated(width, height)  # from one outside the frame, OpenCV's MIL never returns
        left, top, w, h = (round(value) for value in box)
        right, bottom = min(left + max(w, 1), width), min(top + max(h, 1), height)
        left, top = min(max(left, 0), width - 1), min(max(top, 0), height - 1)
        self._tracker = self._create()
        try:
            self._tracker.init(frame, (left, top, max(right - left, 1), max(bottom - top, 1)))
        except cv2.error as error:
            raise BoxError(f"OpenCV does not accept the box {Box(*box)}: {error.err or error}") from None

    def update(self, frame: np.ndarray) -> tuple[bool, Box | None]:
        """Return whether the object was found, and its box. An error inside OpenCV counts as not found."""
        try:
            ok, box = self._tracker.update(frame)
        except cv2.error:
            ok, box = False, None
        return (True, Box(*map(float, box))) if ok else (False, None)


def _constructor(name: str, models: Path | None) -> Callable[[], Any]:
    if name == "nano-v3":
        return partial(_with_models, NanoTrackV3, name, _parameters(name, models))
    for home in (cv2, getattr(cv2, "legacy", None)):
        create: Callable[..., Any] | None = getattr(home, f"{PEERS[name]}_create", None)
        if create is not None:
            return partial(_with_models, create, name, _parameters(name, models)) if name in MODELS else create
    raise SettingsError(
        f"OpenCV {cv2.__version__} has no tracker {name!r}: install the contrib modules of OpenCV 4, "
        f"{install_command('peers')}"
    )


def _parameters(name: str, models: Path | None) -> Any:
    """Return the parameters of a tracker with model files."""
    files = MODELS[name]
    if models is None:
        needed = " and ".join(files.values())
        raise SettingsError(f"the tracker {name!r} needs {needed}: pass their folder with --models")
    missing = [file for file in files.values() if not (models / file).is_file()]
    if missing:
        raise SettingsError(
            f"missing model file of the tracker {name!r} in {str(models)!r}: add {' and '.join(missing)}"
        )
    parameters = getattr(cv2, f"{PEERS[name]}_Params")()
    for parameter, file in files.items():
        setattr(parameters, parameter, str(models / file))
    return parameters


def _with_models(create: Callable[..., Any], name: str, parameters: Any) -> Any:
    """Create a tracker with model files, without the messages that OpenCV prints about them."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return create(parameters)
    except cv2.error as error:
        raise SettingsError(
            f"OpenCV {cv2.__version__} cannot read the model files of the tracker {name!r} "
            f"({' '.join(str(error).split())}): download them again"
        ) from None
    finally:
        cv2.utils.logging.setLogLevel(level)


class NanoTrackV3:
    """NanoTrackV3, from github.com/HonglinChu/SiamTrackers, with the interface of `cv2.TrackerNano`.

    OpenCV's class reads the files of version 2 only.
    """

    def __init__(self, parameters: cv2.TrackerNano.Params) -> None:
        self._backbone = cv2.dnn.readNet(parameters.backbone)
        self._head = cv2.dnn.readNet(parameters.neckhead)
        hanning = np.hanning(_PLACES)
        self._window = np.outer(hanning, hanning)
        self._offsets = (np.arange(_PLACES) - _PLACES // 2) * _STRIDE

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
        move = self._offsets[[column, row]] + [right[best] - left[best], bottom[best] - top[best]] / np.array(2)
        rate = penalty[best] * scores[best] * _RATE
        limits = np.array(frame.shape[1::-1], float)
        self._center = (self._center + move / scale).clip(0, limits)
        detected = np.array([width[best], height[best]]) / scale
        self._size = (self._size * (1 - rate) + detected * rate).clip(_LEAST, np.maximum(limits, _LEAST))
        return True, (*(self._center - self._size / 2), *self._size)

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
