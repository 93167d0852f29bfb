"""Tracks for roboflow's supervision, which draws, counts and filters detections."""

from __future__ import annotations

from typing import Any

import numpy as np

from catstream.extras import require_extra
from catstream.messages import Track

__all__ = ["to_supervision"]


def to_supervision(track: Track) -> Any:
    """A track as `supervision.Detections`: one detection, or none where the object is absent.

    It has the corners of the box, the score from 0 to 1 as confidence, class 0, tracker 1, and in `data` the
    `frame`, `state` and `model_version`. Needs the extra `catstream[supervision]`.

    Raises
    ------
    MissingExtraError
        If supervision is not installed; says how to get it.
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
