"""Several objects in one process: each is followed as if it were alone, and they come and go."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.errors import BoxError, ObjectError, ServiceError, SettingsError
from catstream.multi import MultiTracker

STEPS = {"anna": (4, 1), "ben": (-3, 2), "cleo": (0, -4)}  # pixels a frame
STARTS = {"anna": (40, 30), "ben": (250, 60), "cleo": (150, 180)}


def box_of(name, number):
    (x, y), (dx, dy) = STARTS[name], STEPS[name]
    return Box(x + dx * number, y + dy * number, 40, 40)


@pytest.fixture(scope="module")
def frames():
    """Frames in which three different patches move over noise; they do not touch one another."""
    rng = np.random.default_rng(4)
    background = np.kron(rng.integers(60, 200, (24, 32, 3), np.uint8), np.ones((10, 10, 1), np.uint8))
    patches = {name: np.kron(rng.integers(0, 256, (5, 5, 3), np.uint8), np.ones((8, 8, 1), np.uint8)) for name in STEPS}

    def drawn(number):
        frame = background.copy()
        for name, patch in patches.items():
            x, y, *_ = map(int, box_of(name, number))
            frame[y : y + 40, x : x + 40] = patch
        return frame

    return [drawn(number) for number in range(14)]


def started(frames, names=("anna",), settings=None):
    tracker = MultiTracker(settings)
    tracker.init(frames[0], {name: box_of(name, 0) for name in names})
    return tracker


def followed(frames, names):
    tracker = started(frames, names)
    return [tracker.update(frame) for frame in frames[1:]]


@pytest.fixture(scope="module")
def together(frames):
    """The tracks of all three."""
    return followed(frames, STEPS)


def of(name, frames):
    """The tracks of an object without the versions, which differ between several objects and one: all share a count."""
    return [replace(tracks[name], model_version=0) for tracks in frames if name in tracks]


def test_every_object_is_tracked(together):
    for number, tracks in enumerate(together, start=1):
        assert list(tracks) == list(STEPS)
        for name, track in tracks.items():
            assert (track.object, track.seq, track.frame) == (name, number + 1, number)
            assert track.box.overlap(box_of(name, number)) > 0.6


def test_object_among_several_is_tracked_as_alone(frames, together):
    for name in STEPS:
        assert of(name, together) == of(name, followed(frames, [name]))


#: In which frame an object begins, and in which it is forgotten, if it is.
_LIFE = st.tuples(st.integers(1, 7), st.none() | st.integers(2, 8)).filter(lambda life: life[0] < (life[1] or 9))


def lived(frames, lives):
    """The tracks of objects that begin and are forgotten in frames after the first."""
    tracker, found = started(frames), []
    for number, frame in enumerate(frames[1:], start=1):
        for name, (_, end) in lives.items():
            if number == end:
                tracker.forget(name)
        begin = {name: box_of(name, number) for name, (first, _) in lives.items() if number == first}
        found.append(tracker.update(frame, begin=begin))
    return found


@settings(max_examples=6)
@given(lives=st.fixed_dictionaries({"ben": _LIFE, "cleo": _LIFE}))
def test_objects_that_come_and_go_do_not_affect_one_another(frames, lives):
    frames = frames[:9]
    together = lived(frames, lives)
    for number, tracks in enumerate(together, start=1):
        present = {name for name, (first, end) in lives.items() if first <= number and (end is None or number < end)}
        assert set(tracks) == {"anna", *present}
    for name, life in lives.items():
        assert of(name, together) == of(name, lived(frames, {name: life}))


@pytest.mark.parametrize(
    ("begin", "error", "why"),
    [
        ({"ben": (250, 60, 40, 40), "cleo": (-500, 0, 10, 10)}, BoxError, "^cleo: the box -500,0,10,10"),
        ({"anna": (45, 30, 40, 40), "ben": (250, 60, 0, 40)}, BoxError, "^ben: a box needs"),
        ({"ben": (250, 60, 40, 40), "no name": (150, 180, 40, 40)}, ObjectError, "'no name' is not a name"),
        ({f"object-{i}": (250, 60, 40, 40) for i in range(1000)}, ObjectError, r"too many objects \(\d+, limit 4\)"),
    ],
    ids=["outside", "an old one and an empty one", "a bad name", "too many"],
)
def test_invalid_box_is_named_and_changes_nothing(frames, begin, error, why):
    tracker, other = started(frames, settings={"run.max_objects": 4}), started(frames)
    with pytest.raises(error, match=why):
        tracker.update(frames[1], begin=begin)
    with pytest.raises(error, match=why):
        tracker.init(frames[1], begin)
    with pytest.raises(TypeError):
        tracker.update(frames[1], begin)  # it would be taken for the time
    assert [tracker.update(frame) for frame in frames[1:4]] == [other.update(frame) for frame in frames[1:4]]


def test_forget_drops_one_object(frames):
    with pytest.raises(BoxError, match="call init"):
        MultiTracker().forget("anna")
    tracker = started(frames, STEPS)
    tracker.forget("ben")
    with pytest.raises(ObjectError, match="there is no object 'ben'"):
        tracker.forget("ben")
    assert list(tracker.update(frames[1])) == ["anna", "cleo"]
    for name in ("anna", "cleo"):
        tracker.forget(name)
    assert tracker.update(frames[2]) == {}
    assert tracker.update(frames[3], begin={"ben": box_of("ben", 3)})["ben"].state == "bootstrapping"


@pytest.fixture(scope="module")
def cleo(frames):
    """A saved model of cleo."""
    tracker = started(frames, ["cleo"], {"coreset.size": 8})
    for frame in frames[1:]:
        tracker.update(frame)
    return tracker.saved_model("cleo")


def test_object_of_a_saved_model_does_not_affect_the_others(frames, cleo, tmp_path):
    cleo.save(tmp_path / "cleo")
    tracker, other = (started(frames, settings={"coreset.size": 8}) for _ in range(2))
    for number, frame in enumerate(frames[1:], start=1):
        tracks = tracker.update(frame, search={"cleo": tmp_path / "cleo"} if number == 2 else None)
        assert of("anna", [tracks]) == of("anna", [other.update(frame)])
        if number == 3:  # not found yet
            assert tracks["cleo"].state == "absent"
    assert tracks["cleo"].box.overlap(box_of("cleo", number)) > 0.6
    assert tracks["cleo"].model_version > cleo.model.version
    assert set(cleo.origins) < set(tracker.saved_model("cleo").origins)


def test_invalid_search_changes_nothing(frames, cleo):
    tracker, other = (started(frames, settings={"run.max_objects": most, "coreset.size": 8}) for most in (2, 8))
    for search, error, why in [
        ({"ben": cleo, "cleo": cleo}, ObjectError, r"too many objects \(3, limit 2\)"),
        ({"no name": cleo}, ObjectError, "is not a name"),
        ({3: cleo}, ObjectError, "3 is not a name: expected text"),
        ({"cleo": replace(cleo, settings=Settings())}, SettingsError, "learned with coreset.size=64"),
        ({"cleo": "no file"}, ServiceError, "there is no saved model 'no file'"),
    ]:
        with pytest.raises(error, match=why):
            tracker.update(frames[1], search=search)
    with pytest.raises(ObjectError, match="a box and a saved model"):
        tracker.update(frames[1], begin={"cleo": box_of("cleo", 1)}, search={"cleo": cleo})
    assert [tracker.update(frame) for frame in frames[1:4]] == [other.update(frame) for frame in frames[1:4]]


def test_overlapping_objects_are_together_until_disjoint(frames):
    """They are so if they begin in one frame, and if one begins after the other."""
    for later in (0, 2):
        tracker = MultiTracker()
        tracker.init(frames[0], {"anna": box_of("anna", 0)} | ({} if later else {"face": (50, 35, 20, 20)}))
        for number in range(1, 4):
            begin = {"face": (50 + 4 * number, 35 + number, 20, 20)} if number == later else {}
            tracker.update(frames[number], begin=begin)
        detectors = tracker.detectors.detectors
        assert detectors["face"].state.together == {"anna": 0}
        window = detectors["anna"].state.window
        detectors["anna"].state = replace(detectors["anna"].state, window=window.centred(250, 150))
        tracker.update(frames[4])
        assert detectors["face"].state.together == {}
