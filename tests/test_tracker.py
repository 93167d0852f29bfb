"""The three stages in one process."""

import copy
import math
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.settings import PRESETS, Settings
from catstream.coreset.forest import Forest
from catstream.errors import BoxError, CatstreamError, FrameError, SettingsError
from catstream.tracker import Tracker

_SCM = {"training.bootstrap": "scm", "coreset.size": 36, "training.copies": 5}


@pytest.fixture(scope="module")
def video():
    """Twenty frames of a textured patch that drifts over noise, and its boxes."""
    rng = np.random.default_rng(4)
    background = np.kron(rng.integers(60, 200, (24, 32, 3), np.uint8), np.ones((10, 10, 1), np.uint8))
    patch = np.kron(rng.integers(0, 256, (6, 6, 3), np.uint8), np.ones((8, 8, 1), np.uint8))
    boxes = [Box(80 + 5 * i, 60 + 3 * i, 48, 48) for i in range(20)]
    frames = [background.copy() for _ in boxes]
    for frame, (x, y, w, h) in zip(frames, boxes, strict=True):
        frame[y : y + h, x : x + w] = patch
    return frames, boxes


def started(video, settings=None):
    frames, boxes = video
    tracker = Tracker(settings)
    tracker.init(frames[0], boxes[0])
    return tracker


def follow(video, settings):
    tracker = started(video, settings)
    return [tracker.update(frame)[1] for frame in video[0][1:]], tracker


@pytest.fixture(scope="module")
def boxes_found(video):
    """The boxes that the default settings give."""
    return follow(video, Settings())[0]


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_object_is_tracked_with_each_preset(video, preset):
    found, tracker = follow(video, Settings.load(preset=preset, environment={}).for_length(len(video[0])))
    assert tracker.track.model_version >= 1
    assert tracker.track.seq == len(found) + 1
    pairs = zip(found, video[1][1:], strict=True)
    assert np.mean([box is not None and box.overlap(truth) > 0.5 for box, truth in pairs]) > 0.9


def test_share_of_an_unknown_length_is_an_error(video):
    with pytest.raises(SettingsError, match="for_length"):
        follow(video, Settings(coreset={"share": 0.1}))
    with pytest.raises(SettingsError, match="is unknown"):
        Settings(coreset={"share": 0.1}).for_length(None)


def test_scm_tracks_until_n_rows_make_a_model(video):
    (frames, boxes), states = video, []
    tracker = started(video, _SCM)
    for frame, truth in zip(frames[1:], boxes[1:], strict=True):
        _, box = tracker.update(frame)
        assert box.overlap(truth) > 0.5
        states.append(tracker.track.state)
    assert states == ["bootstrapping"] * 5 + ["present"] * 14  # six rows a frame, in frames 0 to 5


def test_same_frames_give_the_same_boxes_after_another_init(video, boxes_found):
    found, tracker = follow(video, Settings())
    assert found == boxes_found
    frames, boxes = video
    tracker.init(frames[0], boxes[0])
    assert [tracker.update(frame)[1] for frame in frames[1:]] == found


def test_update_before_init_is_an_error(video):
    with pytest.raises(BoxError, match="call init"):
        Tracker().update(video[0][0])


def test_repr_has_the_frame_and_the_state(video):
    assert repr(Tracker()) == "<catstream.Tracker, before init>"
    assert repr(started(video)) == "<catstream.Tracker, at frame 0: the object bootstrapping>"


@pytest.mark.parametrize("bad", [None, np.zeros((3, 240, 320), np.uint8), np.zeros((240, 320), bool)])
def test_invalid_frame_is_an_error_and_changes_nothing(video, bad):
    frames, boxes = video
    tracker = Tracker()
    with pytest.raises(FrameError):
        tracker.init(bad, boxes[0])
    tracker.init(frames[0], boxes[0])
    with pytest.raises(FrameError):
        tracker.update(bad)
    assert (tracker.track.seq, tracker.update(frames[1])[0]) == (1, True)


def test_frame_of_another_size_is_an_error(video):
    with pytest.raises(FrameError, match="this frame is 160x240 pixels, the first one 320x240"):
        started(video).update(video[0][1][:, :160])


def test_trackers_in_two_threads_give_the_same_tracks_as_alone(video, boxes_found):
    with ThreadPoolExecutor(2) as pool:
        one, two = (pool.submit(follow, video, Settings(run={"seed": seed})) for seed in (0, 1))
    assert one.result()[0] == boxes_found
    assert two.result()[0] == follow(video, Settings(run={"seed": 1}))[0]


def test_second_thread_in_a_tracker_is_an_error(video, monkeypatch):
    tracker, alone, take = started(video), started(video), Forest.take

    def taking(*arguments):
        with ThreadPoolExecutor(1) as pool, pytest.raises(CatstreamError, match="one tracker in each thread"):
            pool.submit(tracker.update, video[0][2]).result()
        return take(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(Forest, "take", taking)
        tracker.update(video[0][1])
    alone.update(video[0][1])
    assert tracker.update(video[0][2]) == alone.update(video[0][2])


def test_interrupted_update_does_not_count_its_frame(video, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    tracker = started(video)
    with monkeypatch.context() as patched:
        patched.setattr(Forest, "take", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tracker.update(video[0][1])
    assert tracker.update(video[0][2])[1].overlap(video[1][2]) > 0.7
    assert tracker.track.seq == 2


def test_copied_or_pickled_tracker_continues_equally(video):
    tracker = started(video)
    tracker.update(video[0][1])
    others = copy.deepcopy(tracker), pickle.loads(pickle.dumps(tracker))
    assert {other.update(video[0][2]) for other in others} == {tracker.update(video[0][2])}


@pytest.mark.parametrize("time", [math.nan, math.inf, None, "noon"])
def test_time_that_is_no_finite_number_is_an_error(video, time):
    with pytest.raises(FrameError, match="finite number of seconds"):
        started(video).update(video[0][1], time)
