"""The frames with the largest surprise, at least a second apart."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.messages.kinds import Model, TrainingRows
from catstream.web.surprising import SurprisingFrames, surprise


@pytest.fixture
def pictures():
    return {}


@pytest.fixture
def selection(pictures):
    return SurprisingFrames(pictures)


@pytest.fixture
def see(selection, pictures):
    """Adds the picture of a frame; whether the selection has changed."""

    def one(preview):
        pictures[preview.frame] = preview
        return selection.measure(preview.frame)

    return one


@pytest.fixture
def models(facts):
    """The models of three objects, one of them without a name."""
    return {name: facts.model(1, 0, name) for name in ("", "anna", "ben")}


@pytest.fixture
def add(selection, see, facts, models):
    """Adds a frame to the selection: its features, and its picture."""

    def both(frame, wrong, *names):
        selection.add_features(facts.features(frame, wrong, *names), models)
        see(facts.preview(frame, *names))

    return both


def frames(selection):
    return [one.frame for one in selection.frames]


def test_surprise_is_the_weighted_squared_error_of_the_model(rng):
    rows, labels, weights = rng.normal(size=(7, 5)), rng.uniform(size=7), rng.uniform(1, 3, 7)
    model = Model(1, 0, rng.normal(size=5).astype(np.float32), 0.25)
    narrow = [array.astype(np.float32) for array in (rows, labels, weights)]
    errors = rows @ model.weights + model.bias - labels
    assert surprise(TrainingRows(*narrow), model) == pytest.approx(np.sum(weights * errors**2), rel=1e-4)


def test_of_frames_less_than_a_second_apart_only_the_most_surprising_is_kept(selection, add):
    for frame, wrong in ((10, 1.0), (12, 3.0), (14, 2.0)):
        add(frame, wrong)
    assert frames(selection) == [12]


def test_the_twelve_most_surprising_frames_are_kept_in_the_order_of_the_video(selection, add, rng):
    surprises = {int(20 * place): float(wrong) for place, wrong in enumerate(rng.permutation(40) + 1)}
    for frame, wrong in surprises.items():
        add(frame, wrong)
    assert frames(selection) == sorted(sorted(surprises, key=surprises.get)[-12:])
    assert selection.measured == 40


def test_features_and_picture_of_a_frame_may_arrive_in_either_order(selection, see, facts, models):
    see(facts.preview(0))
    assert selection.add_features(facts.features(0, 1.0), models)
    assert not selection.add_features(facts.features(50, 1.0), models)
    assert see(facts.preview(50))
    assert frames(selection) == [0, 50]


def test_before_the_first_model_nothing_is_measured(selection, add, models):
    models.clear()
    add(0, 1.0)
    assert (frames(selection), selection.measured) == ([], 0)


def test_features_without_a_picture_are_dropped(selection, see, facts, models):
    for frame in range(1000):
        selection.add_features(facts.features(frame, 1.0), models)
    assert not see(facts.preview(0))
    assert see(facts.preview(999))


def test_one_frame_may_be_the_most_surprising_one_of_two_objects(selection, add):
    add(10, 1.0, "anna", "ben")
    add(12, 2.0, "ben")
    assert [(one.frame, one.object) for one in selection.frames] == [(10, "anna"), (12, "ben")]
    assert selection.measured == 3


def test_an_object_that_is_not_in_the_picture_is_not_measured(selection, see, facts, models):
    selection.add_features(facts.features(10, 1.0, "anna", "ben"), models)
    see(facts.preview(10, "ben"))
    assert [(one.frame, one.object) for one in selection.frames] == [(10, "ben")]


def test_nothing_of_a_dropped_object_is_kept(selection, see, facts, add, models):
    add(10, 1.0, "anna", "ben")
    selection.add_features(facts.features(30, 1.0, "anna", "ben"), models)
    selection.drop({"anna"})
    del models["anna"]
    see(facts.preview(30, "anna", "ben"))
    add(50, 1.0, "anna", "ben")
    assert {one.object for one in selection.frames} == {"ben"}
    assert selection.measured == 3
