"""Passes the tracks of a running pipeline to roboflow's supervision, which draws, counts in zones and filters them.

pip install supervision
python examples/to_supervision.py [ENDPOINT]
"""

from __future__ import annotations

import sys
import zlib

import numpy as np
import supervision

import catstream


def detections(tracks: list[catstream.Track]) -> supervision.Detections:
    """A detection for each object that is present; `tracker_id` is the same for a name in all frames."""
    present = [(track, track.box) for track in tracks if track.box is not None]
    if not present:
        return supervision.Detections.empty()
    return supervision.Detections(
        xyxy=np.array([[x, y, x + w, y + h] for _, (x, y, w, h) in present]),
        confidence=np.array([min(max(track.score, 0.0), 1.0) for track, _ in present]),
        class_id=np.zeros(len(present), int),
        tracker_id=np.array([zlib.crc32(track.object.encode()) for track, _ in present]),
    )


if __name__ == "__main__":
    with catstream.subscribe(sys.argv[1] if len(sys.argv) > 1 else "", "tracks") as stream:
        for each in stream:
            print(each.frame, detections([each]))
