"""Converts tracks to detections of Roboflow's supervision library, which draws, counts and filters them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from catstream.extras import require_extra
from catstream.messages import Track

if TYPE_CHECKING:
    from supervision import Detections

__all__ = ["to_supervision"]


def to_supervision(track: Track) -> Detections:
    """Convert a track to `supervision.Detections`: one detection, or none if the object is absent.

    The detection has the corners of the box, the score, clipped to 0 to 1, as its confidence, class 0, tracker 1, and
    `frame`, `state` and `model_version` in `data`. It needs the extra `catstream[supervision]`.

    Raises
    ------
    MissingExtraError
        If supervision is not installed.
    """
    require_extra("supervision")
    from supervision import Detections

    if track.box is None:
        return Detections.empty()
    x, y, w, h = track.box
    return Detections(
        xyxy=np.array([[x, y, x + w, y + h]], np.float32),
        confidence=np.clip(np.array([track.score], np.float32), 0, 1),
        class_id=np.array([0]),
        tracker_id=np.array([1]),
        data={
            "frame": np.array([track.frame]),
            "state": np.array([track.state]),
            "model_version": np.array([track.model_version]),
        },
    )
