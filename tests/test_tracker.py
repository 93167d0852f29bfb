"""The three stages in one process."""

import copy
import math
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from catstream.box import Box
from catstream.compression.forest import Forest
from catstream.errors import BoxError, FrameError, ProtocolError, ServiceError, SettingsError
from catstream.messages import storage
from catstream.settings import PRESETS, Settings
from catstream.tracker import Tracker

_SCM = {"teaching.bootstrap": "scm", "coreset.size": 36, "teaching.copies": 5}


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
def test_a_patch_is_followed(video, preset):
    found, tracker = follow(video, Settings.load(preset=preset, environment={}).for_length(len(video[0])))
    assert tracker.track.model_version >= 1
    assert tracker.track.seq == len(found) + 1
    pairs = zip(found, video[1][1:], strict=True)
    assert np.mean([box is not None and box.overlap(Box(*truth)) > 0.5 for box, truth in pairs]) > 0.9


def test_a_share_of_an_unknown_length_is_rejected(video):
    with pytest.raises(SettingsError, match="for_length"):
        follow(video, Settings(coreset={"share": 0.1}))
    with pytest.raises(SettingsError, match="is not known"):
        Settings(coreset={"share": 0.1}).for_length(None)


def test_scm_follows_the_object_until_n_rows_make_a_model(video):
    (frames, boxes), states = video, []
    tracker = started(video, _SCM)
    for frame, truth in zip(frames[1:], boxes[1:], strict=True):
        _, box = tracker.update(frame)
        assert box.overlap(Box(*truth)) > 0.5
        states.append(tracker.track.state)
    assert states == ["bootstrapping"] * 5 + ["present"] * 14  # six rows a frame, in frames 0 to 5


def test_the_same_frames_give_the_same_boxes_and_init_forgets_all_before(video, boxes_found):
    found, tracker = follow(video, Settings())
    assert found == boxes_found
    frames, boxes = video
    tracker.init(frames[0], boxes[0])
    assert [tracker.update(frame)[1] for frame in frames[1:]] == found


def test_update_before_init_is_rejected(video):
    with pytest.raises(BoxError, match="call init"):
        Tracker().update(video[0][0])


def test_a_tracker_says_what_it_is(video):
    assert repr(Tracker()) == "<catstream.Tracker, before init>"
    assert repr(started(video)) == "<catstream.Tracker, at frame 0: the object bootstrapping>"


def test_frames_of_other_libraries_give_the_boxes_of_the_same_frames(video, boxes_found):
    frames, boxes = video
    read_only = [np.frombuffer(frame.tobytes(), np.uint8).reshape(frame.shape) for frame in frames]
    assert follow((read_only, boxes), Settings())[0] == boxes_found
    assert follow(([frame.astype(np.float32) / 255 for frame in frames], boxes), Settings())[0] == boxes_found


@pytest.mark.parametrize("bad", [None, np.zeros((3, 240, 320), np.uint8), np.zeros((240, 320), bool)])
def test_an_invalid_frame_is_rejected_and_the_tracker_continues(video, bad):
    frames, boxes = video
    tracker = Tracker()
    with pytest.raises(FrameError):
        tracker.init(bad, boxes[0])
    tracker.init(frames[0], boxes[0])
    with pytest.raises(FrameError):
        tracker.update(bad)
    assert (tracker.track.seq, tracker.update(frames[1])[0]) == (1, True)


def test_a_frame_of_another_size_is_rejected(video):
    with pytest.raises(
        FrameError, match="this frame is 160x240 pixels, those before it 320x240: resize it, or call init"
    ):
        started(video).update(video[0][1][:, :160])


def test_settings_may_be_given_as_a_mapping():
    assert Tracker({"coreset.size": 32}).settings == Settings(coreset={"size": 32})


def test_trackers_in_two_threads_give_the_same_tracks_as_alone(video, boxes_found):
    with ThreadPoolExecutor(2) as pool:
        one, two = (pool.submit(follow, video, Settings(run={"seed": seed})) for seed in (0, 1))
    assert one.result()[0] == boxes_found
    assert two.result()[0] == follow(video, Settings(run={"seed": 1}))[0]


def test_a_frame_whose_update_was_interrupted_counts_as_not_seen(video, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    tracker = started(video)
    with monkeypatch.context() as patched:
        patched.setattr(Forest, "take", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tracker.update(video[0][1])
    assert tracker.update(video[0][2])[1].overlap(Box(*video[1][2])) > 0.7
    assert tracker.track.seq == 2


def test_calls_of_several_threads_wait_for_one_another(video):
    frames, tracker = video[0], started(video)
    with ThreadPoolExecutor(3) as pool:
        assert len(list(pool.map(tracker.update, frames[1:]))) == 19
    assert tracker.track.seq == 20
    assert copy.deepcopy(tracker).update(frames[-1]) == pickle.loads(pickle.dumps(tracker)).update(frames[-1])


def results(tracker, frames):
    return [(*tracker.update(frame), tracker.track) for frame in frames]


_SKETCH = {"coreset.reduction": "frequent-directions"}


@pytest.mark.parametrize("settings", [{}, _SCM, _SKETCH], ids=["copies", "scm", "sketch"])
@pytest.mark.parametrize("after", [1, 4, 11], ids="after {} frames".format)
def test_a_saved_tracker_continues_bit_for_bit(video, tmp_path, settings, after):
    frames, tracker = video[0], started(video, settings)
    results(tracker, frames[1:after])
    tracker.save(tmp_path / "kept")
    loaded = Tracker.load(tmp_path / "kept")
    assert (loaded.track, loaded.settings) == (tracker.track, tracker.settings)
    assert results(loaded, frames[after:]) == results(tracker, frames[after:])


def test_times_of_numpy_are_saved_and_one_that_is_not_finite_is_rejected(video, tmp_path):
    tracker = started(video)
    for frame, time in zip(video[0][1:], (np.float32(0.5), np.int64(1)), strict=False):
        tracker.update(frame, time)
    for invalid in (math.nan, math.inf):
        with pytest.raises(FrameError, match="finite number of seconds"):
            tracker.update(video[0][3], invalid)
    tracker.save(tmp_path / "kept")
    assert Tracker.load(tmp_path / "kept").track.time == 1


def test_a_tracker_saved_while_the_object_is_absent_finds_it_as_the_other_does(video, tmp_path):
    frames, tracker = video[0], started(video, {"search.motion_frames": 8})
    results(tracker, [*frames[1:12], *[np.zeros_like(frames[0])] * 3])
    assert tracker.track.state == "absent"
    tracker.save(tmp_path / "kept")
    back = results(tracker, frames[12:])
    assert any(found for found, *_ in back)
    assert results(Tracker.load(tmp_path / "kept"), frames[12:]) == back


_LOADS = """
import sys, numpy as np
from catstream import Tracker
tracker = Tracker.load(sys.argv[1])
for frame in np.load(sys.argv[2]):
    tracker.update(frame)
    print(tracker.track)
"""


def test_another_process_continues_bit_for_bit_with_any_number_of_threads(video, tmp_path):
    frames, tracker = video[0], started(video)
    results(tracker, frames[1:8])
    tracker.save(tmp_path / "kept")
    np.save(tmp_path / "rest.npy", frames[8:])
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    command = [sys.executable, "-P", "-c", _LOADS, tmp_path / "kept", tmp_path / "rest.npy"]
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert told.splitlines() == [str(track) for *_, track in results(tracker, frames[8:])]


def test_a_missing_file_and_one_of_something_else_are_told_apart(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no saved tracker 'nothing'.*`save` writes one") as missing:
        Tracker.load("nothing")
    assert isinstance(missing.value, ServiceError)
    with pytest.raises(ServiceError, match="is not a file"):
        Tracker.load(tmp_path)
    (tmp_path / "text").write_text("root:x:0:0:root:/root:/bin/sh\n")
    with pytest.raises(ProtocolError, match=r"is not an undamaged file of catstream .* a file that catstream wrote"):
        Tracker.load(tmp_path / "text")
    storage.write(tmp_path / "model", {"weights": np.zeros(3)}, {"kind": "learned 1"})
    with pytest.raises(ProtocolError, match="of kind 'learned 1', not 'tracker 3'"):
        Tracker.load(tmp_path / "model")


def test_an_unwritable_place_is_named_as_it_was_given(video, tmp_path):
    with pytest.raises(ServiceError, match=r"cannot write .*: give another place") as error:
        started(video).save(tmp_path / "none" / "x")
    assert ".part" not in str(error.value)


def test_nothing_is_saved_before_init(tmp_path):
    with pytest.raises(BoxError, match="call init"):
        Tracker().save(tmp_path / "kept")
    assert not list(tmp_path.iterdir())


def test_a_tracker_of_other_features_is_rejected(video, tmp_path):
    started(video).save(tmp_path / "kept")
    arrays, metadata = storage.read(tmp_path / "kept")
    shorter = {name: row[:-1].copy() for name, row in arrays.items() if name.startswith("model.0.") and row.ndim == 1}
    storage.write(tmp_path / "kept", arrays | shorter, metadata)
    with pytest.raises(ProtocolError, match="its model has 2463 weights, the features of this catstream are 2464"):
        Tracker.load(tmp_path / "kept")
