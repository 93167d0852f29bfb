"""The detector alone: no trees, no trainer, only the initial model of the first frame."""

import dataclasses

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.detection.detector import Detector
from catstream.detection.objects import Detectors
from catstream.detection.similarity import MIN_SIMILARITY, Similarity
from catstream.errors import BoxError
from catstream.features.layout import ROW_LENGTH
from catstream.features.pyramid import Pyramid
from catstream.wire.heads import APPEARANCE, GROUPS
from catstream.wire.messages import Motion

START = Box(60, 50, 48, 40)


class Follower(Detector):
    """A detector with the number of its last frame, which takes images one after the other."""

    def __init__(self, settings=()):
        super().__init__(Settings().replace(dict(settings)))
        self.seq = 0

    def start(self, image, box, time=0.0, method=Detector.init):
        result = method(self, Pyramid(image), self.seq + 1, time, box)
        self.seq += 1
        return result

    def move(self, image, box):
        return self.start(image, box, method=Detector.correct)

    def step(self, image):
        frame = Pyramid(image)
        detection = self.search(frame, self.seq + 1)
        self.seq += 1
        return self.update(detection, frame, self.seq, 0.0)

    def go_on(self, seq, state, model):
        self.seq = seq
        self.resume(state, model)


def started(scene, settings=(), version=0):
    detector = Follower(settings)
    detector.start(scene((60, 50)), START)
    detector.adopt(dataclasses.replace(detector.model, version=version))
    return detector


@pytest.mark.parametrize("augment", [False, True])
def test_first_frame_has_rows_for_a_leaf_of_each_tree(scene, augment):
    detector = Follower({"training.augment": augment})
    track, features = detector.start(scene((60, 50)), START, time=2.5)
    assert (track.seq, track.frame, track.state, track.time) == (1, 0, "bootstrapping", 2.5)
    assert track.box == pytest.approx(START)
    size, training = detector.settings.coreset.size, features.training[APPEARANCE]
    assert training.rows.shape[1] == ROW_LENGTH
    assert (training.labels == 1).sum() == size <= (training.labels == 0).sum()
    assert set(features.training) == set(GROUPS)
    assert min(map(len, features.training.values())) >= size


@pytest.mark.parametrize("noise", [0, 2])
def test_still_object_trains_in_every_seventh_frame(scene, noise):
    """Noise is the standard deviation of each pixel's level."""
    detector, rng = started(scene, version=1), np.random.default_rng(0)

    def teaches(position):
        image = scene(position) + rng.normal(0, noise, scene().shape)
        return bool(detector.step(image.round().clip(0, 255).astype(np.uint8))[1].training)

    assert all(teaches((60 + 2 * step, 50)) for step in range(8))
    standing = [teaches((74, 50)) for _ in range(38)]
    assert sum(standing[10:]) == 4, "its window comes to rest in the first ten"
    assert teaches((80, 50)), "it moves again"


@pytest.mark.parametrize("interval", [1, 3])
def test_frames_that_a_model_explains_train_at_the_interval(scene, interval):
    detector = started(scene, {"training.interval": interval}, version=1)
    steps = [detector.step(scene((60 + 2 * (number % 2) + number // 2, 50))) for number in range(80)]
    trained = [bool(features.training) for _, features in steps]
    explained = [track.score >= 0.9 for track, _ in steps]
    assert all(trained[:48])
    assert all(explained[50:])
    assert sum(trained[50:]) == pytest.approx(30 / interval, abs=1)


def test_object_that_left_is_absent_and_trains_nothing(scene):
    detector = started(scene)
    for _ in range(3):
        track, features = detector.step(scene())
    assert (track.state, track.box, features.box) == ("absent", None, None)
    assert not features.training


def test_frame_tracked_by_scm_trains_at_any_score(scene):
    """Otherwise there might never be n rows for the first leaf, and SCM would track the object to the end."""
    detector = started(scene, {"training.bootstrap": "scm"})
    track, features = detector.step(scene())
    assert track.score < detector.settings.belief.confident_score
    assert features.training


@pytest.mark.parametrize("detection", ["local", "full"])
@pytest.mark.parametrize(("trust", "teaches"), [(0.0, True), (10.0, False)])
def test_redetected_object_trains_only_if_it_is_trusted(scene, trust, teaches, detection):
    detector = started(scene, {"belief.trusted_score": trust, "search.mode": detection})
    detector.step(scene())
    track, features = detector.step(scene((250, 180)))
    assert features.box.overlap(Box(250, 180, 48, 40)) > 0.6
    assert (bool(features.training), track.doubtful) == (teaches, not teaches)


@pytest.mark.parametrize("absent", [False, True])
def test_resumed_detector_continues_bit_for_bit(scene, absent):
    detector, other = started(scene), Follower()
    model = dataclasses.replace(detector.model, version=1, motion=Motion(np.eye(4), np.eye(2)))
    detector.adopt(model)
    for left in range(60, 84, 4):
        _, features = detector.step(scene((left, 50)))
    if absent:
        _, features = detector.step(scene())
    other.go_on(detector.seq, features.detector, model)
    for left in range(84, 100, 4):
        (track, features), (again, repeated) = (stage.step(scene((left, 50))) for stage in (detector, other))
        assert again == track
        np.testing.assert_equal(dataclasses.asdict(repeated), dataclasses.asdict(features))


@pytest.mark.parametrize(
    ("method", "box"),
    [("start", (400, 10, 20, 20)), ("start", (150, 20, 30, 30)), ("move", (0, 0, 641, 20))],
    ids=["outside", "flat", "huge"],
)
def test_invalid_box_changes_nothing(method, box):
    image = np.full((120, 200, 3), 90, np.uint8)
    image[40:80, 20:60] = np.random.default_rng(2).integers(0, 256, (40, 40, 3))
    detector = Follower()
    detector.start(image, Box(20, 40, 40, 40))
    with pytest.raises(BoxError):
        getattr(detector, method)(image, Box(*box))
    assert (detector.seq, detector.box) == (1, Box(20, 40, 40, 40))
    assert detector.step(image)[0].state != "absent"


def test_box_at_the_edge_has_its_centre_in_the_frame(scene):
    detector = started(scene)
    for x in range(60, -24, -6):
        frame = np.roll(scene((60, 50)), x - 60, axis=1)
        track, _ = detector.step(frame)
        assert track.box is None or 0 <= track.box.centre[0] < 320


def test_new_object_adopts_no_model_of_the_one_before(scene):
    detector, resumed = started(scene, version=1), Follower()
    for left in (60, 62):
        detector.step(scene((left, 50)))
    track, features = detector.start(scene((64, 50)), Box(64, 50, 48, 40))
    assert (track.seq, track.state, track.model_version, features.begins) == (4, "bootstrapping", 0, True)
    initial = detector.model
    detector.adopt(dataclasses.replace(initial, version=1, began=3))
    assert detector.model is initial, "the newest version was as new"
    resumed.go_on(detector.seq, features.detector, initial)
    for each in (detector, resumed):
        each.adopt(dataclasses.replace(initial, version=2))
        assert (each.model.version, each.newest_version) == (0, 2), "it is of the object before"
        each.adopt(dataclasses.replace(initial, version=3, began=3))
        assert each.model.version == 3


@pytest.fixture
def learned(scene):
    """A saved model of the object."""
    return dataclasses.replace(started(scene).model, version=7)


@pytest.fixture
def similarity(scene):
    """To the object of `learned`."""
    training = Follower().start(scene((60, 50)), START)[1].training[APPEARANCE]
    own, other = training.rows[training.labels == 1], training.rows[training.labels == 0]
    return Similarity.of(own, float((own**2).sum()), own.sum(axis=0), len(own), other.mean(axis=0))


def searched(model, similarity, frames, settings=()):
    """Search for an object, as large as START when it was learned: its tracks and features in these frames."""
    detector = Follower(settings)
    detector.seek(model, START, similarity)
    return zip(*[detector.step(frame) for frame in frames], strict=True)


@pytest.fixture
def two(scene):
    """A frame with two objects that look alike."""
    frame = scene((90, 60))
    frame[150:190, 200:248] = frame[60:100, 90:138]
    return frame


def test_saved_model_finds_its_object_in_new_frames(scene, learned, similarity):
    tracks, features = searched(learned, similarity, [scene(), *[scene((90, 60))] * 3])
    assert [track.state for track in tracks] == ["absent"] * 3 + ["present"]
    trained = [any(rows.labels.any() for rows in each.training.values()) for each in features]
    assert trained == [False] * 3 + [True], "before, nothing is learned of the object"
    assert {track.model_version for track in tracks} == {7}
    assert tracks[-1].box.overlap(Box(90, 60, 48, 40)) > 0.6


@pytest.mark.parametrize("before", [0, 2], ids="frames before: {}".format)
@pytest.mark.parametrize("factor", [0.5, 1.5, 2.0], ids="size: {}".format)
def test_first_box_of_a_saved_model_has_the_size_of_its_object(scene, learned, similarity, factor, before):
    frame = cv2.resize(scene((90, 60)), None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    empty = cv2.resize(scene(), None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    tracks, _ = searched(learned, similarity, [empty] * before + [frame] * 5)
    box = next(track.box for track in tracks if track.box is not None)
    assert np.sqrt(box.area / (48 * 40)) == pytest.approx(factor, rel=0.15)


@pytest.mark.parametrize("wrong", ["rivalled", "dissimilar", "jumping"])
def test_rivalled_dissimilar_or_jumping_window_is_no_detection(wrong, scene, two, learned, similarity):
    frames = [scene((90, 60))] * 9
    if wrong == "rivalled":
        frames = [two] * 9
    elif wrong == "dissimilar":
        similarity = dataclasses.replace(similarity, basis=np.roll(similarity.basis, 1, axis=1))
    else:
        frames = [scene((90, 60)), scene((200, 150)), scene((20, 150))] * 3
    tracks, _ = searched(learned, similarity, frames)
    assert {track.state for track in tracks} == {"absent"}
    assert tracks[-1].score > Settings().belief.confident_score


def test_search_for_a_saved_model_trains_on_the_background(two, learned, similarity):
    _, features = searched(learned, similarity, [two] * 4, {"belief.weak_score": 0.1})  # neither of the two is found
    rows = [rows for each in features for rows in each.training.values()]
    assert rows
    assert all(not each.labels.any() for each in rows)
    assert all(similarity(row) < MIN_SIMILARITY for each in rows for row in each.rows)


def test_a_resumed_search_continues_bit_for_bit(scene, learned, similarity):
    (tracks, features), other = searched(learned, similarity, [scene((90, 60))] * 5), Follower()
    assert features[1].detector.sightings == 2
    other.go_on(2, features[1].detector, learned)
    other.similarity = similarity
    assert tuple(other.step(scene((90, 60)))[0] for _ in range(3)) == tracks[2:]


def test_box_of_a_past_frame_is_tracked_to_the_newest_one(scene):
    places = [(60 + 6 * i, 50 + 4 * i) for i in range(10)]
    now = Box(*places[-1], 48, 40)
    detectors = Detectors(Settings())
    first, *later = (Pyramid(scene(place)) for place in places)
    track, features = detectors.begin("", first, START, 0.4, later)
    assert (track.seq, track.time, track.began, features.begins) == (1, 0.4, 0, True)
    assert track.box.overlap(now) > 0.8
    _, alone = Detectors(Settings()).begin("", first, START)
    assert all((features.training[group].rows == alone.training[group].rows).all() for group in GROUPS)
    detectors.step(later[-1], results={"": (track, features)})
    track, _ = detectors.correct("", first, START, later=later)
    assert (track.seq, track.began) == (2, 0)
    assert track.box.overlap(now) > 0.8


def test_corrected_box_is_trained_on_and_tracked_on(scene):
    detector = started(scene, version=1)
    track, features = detector.move(scene((90, 60)), Box(90, 60, 48, 40))
    assert (track.seq, track.state, track.model_version) == (2, "present", 1)
    assert track.box == Box(90, 60, 48, 40)
    assert len(features.training[APPEARANCE])
    assert not features.begins
    assert detector.step(scene((92, 60)))[0].box.overlap(Box(92, 60, 48, 40)) > 0.7
