"""filterpy is imported while frames are followed: nobody waits for it, and no result depends on it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from catstream import kalman
from catstream.settings import Settings
from catstream.tracker import Tracker


def test_the_first_models_need_no_filterpy_and_its_import_begins_half_a_block_of_centres_ahead(monkeypatch, rng):
    begun = []
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)  # an import of it fails
    monkeypatch.setattr(kalman, "prepare", lambda: begun.append(tracker.track.frame))
    frame, tracker = (
        rng.integers(0, 256, (120, 160, 3), np.uint8),
        Tracker(Settings(search={"motion_frames": 8})),
    )
    tracker.init(frame, (60, 40, 40, 40))
    for _ in range(4):
        assert not begun
        tracker.update(frame)
    assert begun == [4]
    assert tracker.track.model_version


def test_a_filter_requested_during_the_import_waits_for_it_without_output():
    code = """
import numpy as np
from catstream.kalman import constant_velocity, prepare
prepare()
kalman = constant_velocity(np.ones(4), np.eye(4), np.eye(4), np.eye(2))
kalman.predict()
print(*kalman.x)
"""
    ended = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)
    assert (ended.stdout, ended.stderr) == ("2.0 2.0 1.0 1.0\n", "")
