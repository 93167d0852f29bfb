"""Adapters for OpenCV's trackers, so that they can be evaluated on the same frames.

MIL comes with every OpenCV; CSRT, KCF and TLD with the contrib modules of
OpenCV 4: `pip install "catstream[peers]"`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from catstream.box import Box
from catstream.errors import BoxError, SettingsError
from catstream.extras import install_command

__all__ = ["OPENCV", "PEERS", "Peer"]

OPENCV: str = cv2.__version__  #: version of OpenCV

#: Name on the command line -> class in OpenCV.
PEERS = {"csrt": "TrackerCSRT", "kcf": "TrackerKCF", "mil": "TrackerMIL", "tld": "TrackerTLD"}


class Peer:
    """One of OpenCV's trackers with the interface of `catstream.tracker.Tracker`.

    Raises
    ------
    SettingsError
        If the installed OpenCV does not have this tracker.
    """

    def __init__(self, name: str) -> None:
        self._create = _constructor(name)
        self._tracker: Any = None

    def init(self, frame: np.ndarray, box: Sequence[float]) -> None:
        """Start with a box x, y, w, h in pixels. It is rounded and clipped to the frame, as OpenCV's trackers need it.

        Raises
        ------
        BoxError
            If OpenCV does not accept the box.
        """
        height, width = frame.shape[:2]
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
            found, box = self._tracker.update(frame)
        except cv2.error:
            return False, None
        return (True, Box(*map(float, box))) if found else (False, None)


def _constructor(name: str) -> Callable[[], Any]:
    for home in (cv2, getattr(cv2, "legacy", None)):
        create: Callable[[], Any] | None = getattr(home, f"{PEERS[name]}_create", None)
        if create is not None:
            return create
    raise SettingsError(
        f"OpenCV {OPENCV} has no tracker {name!r}: install the contrib modules of OpenCV 4, {install_command('peers')}"
    )
