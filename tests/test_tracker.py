"""The three stages in one process."""

import numpy as np
import pytest

from catstream.box import Box
from catstream.errors import BoxError, SettingsError
from catstream.settings import PRESETS, Settings
from catstream.tracker import Tracker


@pytest.fixture(scope="module")
def video():
    """Twenty frames of a textured patch that drifts over noise, and where it is."""
    rng = np.random.default_rng(4)
    background = np.kron(rng.integers(60, 200, (24, 32, 3), np.uint8), np.ones((10, 10, 1), np.uint8))
    patch = np.kron(rng.integers(0, 256, (6, 6, 3), np.uint8), np.ones((8, 8, 1), np.uint8))
    frames, boxes = [], []
    for i in range(20):
        x, y = 80 + 5 * i, 60 + 3 * i
        frame = background.copy()
        frame[y : y + 48, x : x + 48] = patch
        frames.append(frame)
        boxes.append((x, y, 48, 48))
    return frames, boxes


def follow(video, settings):
    frames, boxes = video
    tracker = Tracker(settings)
    tracker.init(frames[0], boxes[0])
    return [tracker.update(frame)[1] for frame in frames[1:]], tracker


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_a_patch_is_followed(video, preset):
    found, tracker = follow(video, Settings.load(preset=preset, environment={}).for_length(len(video[0])))
    assert tracker.track.model_version >= 1
    assert tracker.compressor.seq == len(found) + 1
    pairs = zip(found, video[1][1:], strict=True)
    assert np.mean([box is not None and box.overlap(Box(*truth)) > 0.5 for box, truth in pairs]) > 0.9


def test_a_share_of_an_unknown_length_is_refused(video):
    with pytest.raises(SettingsError, match="for_length"):
        follow(video, Settings(coreset_share=0.1))
    with pytest.raises(SettingsError, match="has none"):
        Settings(coreset_share=0.1).for_length(None)


def test_scm_follows_the_object_until_n_rows_make_a_model(video):
    frames, boxes = video
    tracker = Tracker(Settings(bootstrap="scm", coreset_size=36, copies=5))
    tracker.init(frames[0], boxes[0])
    states = []
    for frame, truth in zip(frames[1:], boxes[1:], strict=True):
        _, box = tracker.update(frame)
        assert box.overlap(Box(*truth)) > 0.5
        states.append(tracker.track.state)
    assert states == ["bootstrapping"] * 5 + ["present"] * 14  # six rows a frame, in frames 0 to 5


def test_the_same_frames_give_the_same_boxes(video):
    assert follow(video, Settings())[0] == follow(video, Settings())[0]


def test_init_forgets_all_before(video):
    found, tracker = follow(video, Settings())
    frames, boxes = video
    tracker.init(frames[0], boxes[0])
    assert [tracker.update(frame)[1] for frame in frames[1:]] == found


def test_update_before_init_is_refused(video):
    with pytest.raises(BoxError, match="call init"):
        Tracker().update(video[0][0])


def test_a_refused_box_leaves_what_is_followed(video):
    frames, boxes = video
    tracker = Tracker()
    tracker.init(frames[0], boxes[0])
    with pytest.raises(BoxError):
        tracker.init(frames[1], (-500, 0, 10, 10))
    found, box = tracker.update(frames[1])
    assert found
    assert box.overlap(Box(*boxes[1])) > 0.5
