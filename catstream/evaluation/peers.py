"""Adapters for OpenCV's trackers, so that they can be evaluated on the same frames.

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

from catstream.base.box import Box
from catstream.errors import BoxError, SettingsError, install_command
from catstream.evaluation.nanotrack import NanoTrackV3

OPENCV: str = cv2.__version__  #: version of OpenCV

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


class Peer:
    """One of OpenCV's trackers with the interface of `catstream.tracker.Tracker`.

    name    one of `PEERS`
    models  folder of the files in `MODELS`
    score   confidence of the last box; 1 if the tracker has none, 0 if the object was not found
    """

    def __init__(self, name: str, models: Path | None = None) -> None:
        self._create = _constructor(name, models)
        self._tracker = self._create()  # so that unreadable model files are noticed before the first frame
        self._has_score = name in MODELS
        self.score = 0.0

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
        self.score = 1.0

    def update(self, frame: np.ndarray) -> tuple[bool, Box | None]:
        """Return whether the object was found, and its box. An error inside OpenCV counts as not found."""
        try:
            ok, box = self._tracker.update(frame)
        except cv2.error:
            ok, box = False, None
        if ok and self._has_score:
            self.score = float(self._tracker.getTrackingScore())
        else:
            self.score = float(ok)
        return (True, Box(*map(float, box))) if ok else (False, None)


def _constructor(name: str, models: Path | None) -> Callable[[], Any]:
    if name == "nano-v3":
        return partial(_with_models, NanoTrackV3, name, _parameters(name, models))
    for home in (cv2, getattr(cv2, "legacy", None)):
        create: Callable[..., Any] | None = getattr(home, f"{PEERS[name]}_create", None)
        if create is not None:
            return partial(_with_models, create, name, _parameters(name, models)) if name in MODELS else create
    raise SettingsError(
        f"OpenCV {OPENCV} has no tracker {name!r}: install the contrib modules of OpenCV 4, {install_command('peers')}"
    )


def _parameters(name: str, models: Path | None) -> Any:
    """Return the parameters of a tracker with model files."""
    files = MODELS[name]
    if models is None:
        needed = " and ".join(files.values())
        raise SettingsError(f"the tracker {name!r} needs {needed}: pass their folder with --peer-models")
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
            f"OpenCV {OPENCV} cannot read the model files of the tracker {name!r} ({' '.join(str(error).split())}): "
            "download them again"
        ) from None
    finally:
        cv2.utils.logging.setLogLevel(level)
