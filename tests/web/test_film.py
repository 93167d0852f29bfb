"""The film: the frames that taught most, a second apart."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.messages import Model, TrainingRows
from catstream.web.film import Film, surprise


@pytest.fixture
def film(facts):
    film = Film()
    film.adopt(facts.model(1, frame=0))
    return film


def shoot(film, facts, frame, wrong):
    film.learn(facts.features(frame, wrong))
    film.look(facts.preview(frame))


def frames(film):
    return [shot.frame for shot in film.shots]


def test_surprise_is_the_weighted_squared_error_of_the_model(rng):
    rows, labels, weights = rng.normal(size=(7, 5)), rng.uniform(size=7), rng.uniform(1, 3, 7)
    model = Model(1, 0, rng.normal(size=5).astype(np.float32), 0.25)
    narrow = [array.astype(np.float32) for array in (rows, labels, weights)]
    errors = rows @ model.weights + model.bias - labels
    assert surprise(TrainingRows(*narrow), model) == pytest.approx(np.sum(weights * errors**2), rel=1e-4)


def test_of_neighbours_only_the_one_that_taught_most_is_kept(film, facts):
    for frame, wrong in ((10, 1.0), (12, 3.0), (14, 2.0)):
        shoot(film, facts, frame, wrong)
    assert frames(film) == [12]


def test_the_twelve_that_taught_most_are_kept_in_the_order_of_the_video(film, facts, rng):
    taught = {int(20 * place): float(wrong) for place, wrong in enumerate(rng.permutation(40) + 1)}
    for frame, wrong in taught.items():
        shoot(film, facts, frame, wrong)
    assert frames(film) == sorted(sorted(taught, key=taught.get)[-12:])
    assert film.frames == 40


def test_a_frame_counts_whichever_comes_first_lesson_or_picture(film, facts):
    film.look(facts.preview(0))
    assert film.learn(facts.features(0, 1.0))
    assert not film.learn(facts.features(50, 1.0))
    assert film.look(facts.preview(50))
    assert frames(film) == [0, 50]


def test_before_the_first_model_nothing_is_measured(facts):
    film = Film()
    shoot(film, facts, 0, 1.0)
    assert (frames(film), film.frames) == ([], 0)


def test_lessons_without_a_picture_are_forgotten(film, facts):
    for frame in range(1000):
        film.learn(facts.features(frame, 1.0))
    assert not film.look(facts.preview(0))
    assert film.look(facts.preview(999))
