"""Two objects are not at the same position of a frame, unless they were together from the start."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.detection.context import FrameContext
from catstream.detection.objects import assign
from catstream.detection.search import Detection, local_search
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap
from catstream.wire.messages import DetectorState, Model


def state(x, first_frame=0):
    window = Window.around(Box(x, 50, 40, 40))
    return DetectorState(first_frame, "confident", window, window, window)


UNCERTAIN = ["lost", "redetected", "weak"]
LEVELS = ["confident", *UNCERTAIN]
DISJOINT = {"anna": state(20), "ben": state(200)}


def detection(score, x, around=None):
    return Detection(score, Window.around(Box(x, 50, 40, 40)), around)


def scores_around(x, left):
    """Scores of 0.1, except for the windows 25 pixels to the left."""
    scores = np.full((3, 9), 0.1, np.float32)
    scores[:, 0] = left
    return ScoreMap(None, scores, (x - 25.0, 45.0), (5.0, 5.0))


def test_disjoint_detections_stay_the_same():
    detections = {"anna": detection(0.9, 100), "ben": detection(0.8, 120)}
    assert assign(detections, DISJOINT) == detections
    assert assign({}, {}) == {}


@pytest.mark.parametrize("order", [("anna", "ben"), ("ben", "anna")])
def test_contested_position_belongs_to_the_higher_score(order):
    both = {"anna": detection(0.9, 100), "ben": detection(0.8, 104)}
    detections = {name: both[name] for name in order}
    result = assign(detections, DISJOINT)
    assert result["anna"] is detections["anna"]
    assert result["ben"].score == 0
    assert list(result) == list(order)


def test_object_between_two_keeps_its_position_or_they_do():
    """The one in the middle is at the position of both."""
    states = {name: state(100 * i) for i, name in enumerate(("left", "right", "middle"))}
    for middle, expected in ((0.7, {"left", "right"}), (0.95, {"middle"})):
        detections = {"left": detection(0.9, 100), "right": detection(0.8, 124), "middle": detection(middle, 112)}
        result = assign(detections, states)
        assert {name for name, each in result.items() if each.score > 0} == expected


@given(
    st.lists(st.tuples(st.floats(0.1, 1), st.integers(80, 140), st.sampled_from(LEVELS)), min_size=2, max_size=5),
    st.randoms(),
)
def test_no_two_objects_have_the_same_position(objects, random):
    def around(x):
        scores = np.array([[random.random() for _ in range(9)] for _ in range(3)], np.float32)
        return ScoreMap(None, scores, (x - 20.0, 40.0), (5.0, 5.0))

    detections = {str(i): detection(score, x, around(x)) for i, (score, x, _) in enumerate(objects)}
    states = {str(i): replace(state(100 * i), level=level) for i, (_, _, level) in enumerate(objects)}
    result = assign(detections, states)
    boxes = [each.window.box() for each in result.values() if each.score > 0]
    assert boxes
    assert all(one.overlap(other) <= 0.5 for one, other in combinations(boxes, 2))


def test_object_yields_to_an_assigned_one_of_lower_score():
    detections = {
        "anna": detection(0.8, 108, scores_around(108, 0.1)),
        "ben": detection(0.8, 108, scores_around(108, 0.55)),
        "carl": detection(0.7, 112, scores_around(112, 0.55)),  # would lose most
    }
    result = assign(detections, dict.fromkeys(detections, replace(state(20), level="weak")))
    assert [name for name, each in result.items() if each is detections[name]] == ["carl"]


def test_objects_that_are_together_share_a_position():
    detections = {"anna": detection(0.9, 100), "ben": detection(0.8, 104)}
    later = state(110, first_frame=7)
    assert assign(detections, DISJOINT | {"ben": replace(later, together={"anna": 0})}) == detections
    assert assign(detections, DISJOINT | {"ben": later})["ben"].score == 0
    of_another_anna = replace(later, together={"anna": 3})
    assert assign(detections, DISJOINT | {"ben": of_another_anna})["ben"].score == 0


@pytest.mark.parametrize(("side", "score"), [(40, 0.7), (40, 0.9), (15, 0.9)])
@pytest.mark.parametrize(
    ("level", "redetected", "keeps"),
    [("confident", False, True), ("confident", True, False), *[(level, False, False) for level in UNCERTAIN]],
)
def test_uncertain_object_gets_no_part_of_another(side, score, level, redetected, keeps):
    part = Window.around(Box(122, 60, side, side))
    detections = {"anna": detection(0.8, 100), "ben": Detection(score, part, redetected=redetected)}
    result = assign(detections, DISJOINT | {"ben": replace(DISJOINT["ben"], level=level)})
    assert result["anna"] is detections["anna"]
    assert (result["ben"].score > 0) is keeps


@pytest.mark.parametrize(("score", "winner"), [(0.6, "anna"), (1.0, "anna"), (1.2, "ben")])
def test_uncertain_object_displaces_only_by_a_clear_lead(score, winner):
    """The certain one has nearly as good a window next to it, so its score would fall less."""
    detections = {
        "anna": detection(0.7, 100, scores_around(100, 0.65)),
        "ben": detection(score, 104, scores_around(104, 0.1)),
    }
    result = assign(detections, DISJOINT | {"ben": replace(DISJOINT["ben"], level="redetected")})
    assert result[winner] is detections[winner]
    assert [name for name in detections if result[name] is detections[name]] == [winner]


def test_object_that_loses_its_position_gets_the_next_best(rng):
    frame = Pyramid(rng.integers(0, 256, (200, 300, 3), np.uint8))
    window = Window.around(Box(100, 50, 40, 40))
    row = ScoreMap.around(frame, window, WINDOW, None).cells.row(0, 0)
    detection_of_ben = local_search(FrameContext(frame, Model(1, 0, row, 0.0), Settings()), window)
    detection_of_ben = replace(detection_of_ben, redetected=True)
    result = assign({"anna": Detection(1e9, detection_of_ben.window), "ben": detection_of_ben}, DISJOINT)["ben"]
    assert 0 < result.score < detection_of_ben.score
    assert result.window.box().overlap(detection_of_ben.window.box()) <= 0.5
    assert result.around is detection_of_ben.around
    assert result.redetected, "it is elsewhere in the frame, so its object is not trusted"
