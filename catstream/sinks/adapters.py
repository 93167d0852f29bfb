"""Converts tracks to detections of Roboflow's supervision library, which draws, counts and filters them."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from catstream.errors import require_extra
from catstream.messages.kinds import Track
from catstream.messages.names import UNNAMED

if TYPE_CHECKING:
    from supervision import Detections


def to_supervision(tracks: Track | Iterable[Track] | Mapping[str, Track]) -> Detections:
    """Convert a track, or the tracks of a frame, to `supervision.Detections`: a detection for each object present.

    A detection has the corners of the box, the score, clipped to 0 to 1, as its confidence, class 0, and `frame`,
    `state`, `model_version` and `object` in `data`. `tracker_id` is 1 for the object without a name, otherwise the
    CRC-32 of its name: it is the same in all frames. This function needs the extra `catstream[supervision]`.

    Raises
    ------
    MissingExtraError
        If supervision is not installed.
    """
    require_extra("supervision")
    from supervision import Detections

    several = [tracks] if isinstance(tracks, Track) else tracks.values() if isinstance(tracks, Mapping) else tracks
    present = [(track, track.box) for track in several if track.box is not None]
    if not present:
        return Detections.empty()
    return Detections(
        xyxy=np.array([[x, y, x + w, y + h] for _, (x, y, w, h) in present], np.float32),
        confidence=np.clip(np.array([track.score for track, _ in present], np.float32), 0, 1),
        class_id=np.zeros(len(present), int),
        tracker_id=np.array([_tracker_id(track.object) for track, _ in present]),
        data={
            name: np.array([getattr(track, name) for track, _ in present])
            for name in ("frame", "state", "model_version", "object")
        },
    )


def _tracker_id(name: str) -> int:
    return 1 if name == UNNAMED else zlib.crc32(name.encode())
