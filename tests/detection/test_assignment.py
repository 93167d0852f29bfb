"""Two objects do not claim the same place of a frame, unless they were given there."""

import numpy as np
import pytest

from catstream.box import Box, Window
from catstream.detection.assignment import assigned
from catstream.detection.search import Detection, ScoreMap, local
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.messages import DetectorState, Model
from catstream.settings import SearchSettings

CONTEXT = 1.25


def state(x, first_frame=0):
    window = Window.around(Box(x, 50, 40, 40), CONTEXT)
    return DetectorState(first_frame, "confident", window, window, window)


APART = {"anna": state(20), "ben": state(200)}


def detection(score, x, around=None):
    return Detection(score, Window.around(Box(x, 50, 40, 40), CONTEXT), around)


def test_detections_at_different_places_stay_the_same():
    found = {"anna": detection(0.9, 100), "ben": detection(0.8, 120)}
    assert assigned(found, APART, CONTEXT) == found
    assert assigned({}, {}, CONTEXT) == {}


@pytest.mark.parametrize("order", [("anna", "ben"), ("ben", "anna")])
def test_of_two_objects_at_one_place_the_one_with_the_higher_score_keeps_it(order):
    both = {"anna": detection(0.9, 100), "ben": detection(0.8, 104)}
    found = {name: both[name] for name in order}
    result = assigned(found, APART, CONTEXT)
    assert result["anna"] is found["anna"]
    assert result["ben"].score == 0
    assert list(result) == list(order)


def test_only_one_of_several_objects_keeps_a_place():
    found = {f"object-{i}": detection(0.5 + i / 10, 100 + i) for i in range(4)}
    states = {f"object-{i}": state(100 * i) for i in range(4)}
    scores = {name: each.score for name, each in assigned(found, states, CONTEXT).items()}
    assert scores == {"object-0": 0, "object-1": 0, "object-2": 0, "object-3": 0.8}


def test_objects_whose_first_boxes_overlap_may_stay_at_one_place():
    found = {"anna": detection(0.9, 100), "ben": detection(0.8, 104)}
    together = {"anna": state(100), "ben": state(110)}
    assert assigned(found, together, CONTEXT) == found
    one_later = {"anna": state(100), "ben": state(110, first_frame=7)}
    assert assigned(found, one_later, CONTEXT)["ben"].score == 0


def test_an_object_that_loses_its_place_takes_the_best_other_window_near_it(rng):
    frame = Pyramid.of(rng.integers(0, 256, (200, 300, 3), np.uint8))
    window = Window.around(Box(100, 50, 40, 40), CONTEXT)
    row = ScoreMap.around(frame, window, WINDOW, None).row(0, 0)
    found = local(frame, window, Model(1, 0, row, 0.0), SearchSettings())
    result = assigned({"anna": Detection(1e9, found.window), "ben": found}, APART, CONTEXT)["ben"]
    assert 0 < result.score < found.score
    assert result.window.box(CONTEXT).overlap(found.window.box(CONTEXT)) <= 0.5
    assert result.around is found.around
