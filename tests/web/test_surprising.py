"""The frames with the largest surprise, at least a second apart."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.messages.kinds import Model, TrainingRows
from catstream.web.surprising import SurprisingFrames, surprise


@pytest.fixture
def selection(facts):
    selection = SurprisingFrames()
    selection.adopt(facts.model(1, frame=0))
    return selection


def add(selection, facts, frame, wrong, *names):
    selection.add_features(facts.features(frame, wrong, *names))
    selection.add_preview(facts.preview(frame, *names))


def frames(selection):
    return [one.frame for one in selection.frames]


def test_surprise_is_the_weighted_squared_error_of_the_model(rng):
    rows, labels, weights = rng.normal(size=(7, 5)), rng.uniform(size=7), rng.uniform(1, 3, 7)
    model = Model(1, 0, rng.normal(size=5).astype(np.float32), 0.25)
    narrow = [array.astype(np.float32) for array in (rows, labels, weights)]
    errors = rows @ model.weights + model.bias - labels
    assert surprise(TrainingRows(*narrow), model) == pytest.approx(np.sum(weights * errors**2), rel=1e-4)


def test_of_frames_less_than_a_second_apart_only_the_most_surprising_is_kept(selection, facts):
    for frame, wrong in ((10, 1.0), (12, 3.0), (14, 2.0)):
        add(selection, facts, frame, wrong)
    assert frames(selection) == [12]


def test_the_twelve_most_surprising_frames_are_kept_in_the_order_of_the_video(selection, facts, rng):
    surprises = {int(20 * place): float(wrong) for place, wrong in enumerate(rng.permutation(40) + 1)}
    for frame, wrong in surprises.items():
        add(selection, facts, frame, wrong)
    assert frames(selection) == sorted(sorted(surprises, key=surprises.get)[-12:])
    assert selection.measured == 40


def test_features_and_picture_of_a_frame_may_arrive_in_either_order(selection, facts):
    selection.add_preview(facts.preview(0))
    assert selection.add_features(facts.features(0, 1.0))
    assert not selection.add_features(facts.features(50, 1.0))
    assert selection.add_preview(facts.preview(50))
    assert frames(selection) == [0, 50]


def test_before_the_first_model_nothing_is_measured(facts):
    selection = SurprisingFrames()
    add(selection, facts, 0, 1.0)
    assert (frames(selection), selection.measured) == ([], 0)


def test_features_without_a_picture_are_dropped(selection, facts):
    for frame in range(1000):
        selection.add_features(facts.features(frame, 1.0))
    assert not selection.add_preview(facts.preview(0))
    assert selection.add_preview(facts.preview(999))


@pytest.fixture
def two(facts):
    """A selection of the frames of two objects."""
    selection = SurprisingFrames()
    for name in ("anna", "ben"):
        selection.adopt(facts.model(1, 0, name))
    return selection


def test_one_frame_may_be_the_most_surprising_one_of_two_objects(two, facts):
    add(two, facts, 10, 1.0, "anna", "ben")
    add(two, facts, 12, 2.0, "ben")
    assert [(one.frame, one.object) for one in two.frames] == [(10, "anna"), (12, "ben")]
    assert two.measured == 3


def test_an_object_that_is_not_in_the_picture_is_not_measured(two, facts):
    two.add_features(facts.features(10, 1.0, "anna", "ben"))
    two.add_preview(facts.preview(10, "ben"))
    assert [(one.frame, one.object) for one in two.frames] == [(10, "ben")]


def test_nothing_of_a_dropped_object_is_kept(two, facts):
    add(two, facts, 10, 1.0, "anna", "ben")
    two.add_features(facts.features(30, 1.0, "anna", "ben"))
    two.drop({"anna"})
    two.add_preview(facts.preview(30, "anna", "ben"))
    add(two, facts, 50, 1.0, "anna", "ben")
    assert {one.object for one in two.frames} == {"ben"}
    assert two.measured == 3
