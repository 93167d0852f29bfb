"""Lessons: which windows a frame teaches, and what they are worth."""

import numpy as np
import pytest

from catstream.box import Box
from catstream.detection import lessons, search
from catstream.features.cells import row_length
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.messages import Model
from catstream.settings import Settings

BOX = Box(120, 80, 64, 64)
SETTINGS = Settings(teaching={"near_misses": 200})


@pytest.fixture
def frame(texture):
    return Pyramid(texture(240, 320, 12))


@pytest.fixture
def model(rng):
    return Model(1, 0, rng.normal(size=row_length()).astype(np.float32), 0.0)


def near(frame, model, around=None, box=BOX):
    lesson = lessons.near(frame, box, model, np.random.default_rng(3), SETTINGS, around)
    own = lesson.labels == 1
    return lesson, own, (lesson.labels > 0) & ~own, lesson.labels == 0


def places(scored, rows):
    """Row and column of the windows that feature rows were taken from."""
    rows = {row.tobytes() for row in rows}
    return [place for place in np.ndindex(scored.scores.shape) if scored.row(*place).tobytes() in rows]


def test_a_near_miss_is_worth_what_its_distance_says(frame, model):
    around = search.scored_around(frame, BOX, 20, model)
    lesson, _, misses, _ = near(frame, model, around)
    row, column = around.place(BOX)
    assert (row, column) == (6, 6)
    worth = {around.row(*place).tobytes(): np.hypot(place[0] - row, place[1] - column) for place in np.ndindex(13, 13)}
    assert misses.sum() > 100
    for features, label in zip(lesson.rows[misses], lesson.labels[misses], strict=True):
        assert label == pytest.approx(np.exp(-((worth[features.tobytes()] / SETTINGS.teaching.near_sigma) ** 2) / 2))


def test_between_the_cells_what_is_nearer_than_most_of_a_cell_is_no_miss(frame, model):
    around = search.scored_around(frame, BOX, 20, model)
    box = BOX.centred(BOX.centre[0] + 4, BOX.centre[1] - 3)  # half a cell of 8 pixels, and less
    lesson, _, misses, _ = near(frame, model, around, box)
    row, column = around.place(box)
    distances = [np.hypot(place[0] - row, place[1] - column) for place in places(around, lesson.rows[misses])]
    assert 0.9 < min(distances) < max(distances) < 4


def test_background_is_beyond_the_near_misses_and_half_of_it_scores_highest(frame, model):
    around = search.scored_around(frame, BOX, 20, model)
    lesson, _, _, background = near(frame, model, around)
    assert background.sum() == SETTINGS.teaching.near_negatives
    taken = places(around, lesson.rows[background])
    assert all(max(abs(row - 6), abs(column - 6)) > 2 for row, column in taken)
    outside = [place for place in np.ndindex(13, 13) if max(abs(place[0] - 6), abs(place[1] - 6)) > 2]
    best = max(outside, key=lambda place: around.scores[place])
    assert best in taken


def test_the_object_at_the_edge_of_what_was_searched_teaches_as_well(frame, model):
    around = search.scored_around(frame, BOX, 20, model)
    edge = around.box(0, 12)
    lesson, own, misses, background = near(frame, model, around, edge)
    assert own.sum() == 1 + SETTINGS.teaching.copies
    assert background.sum() == SETTINGS.teaching.near_negatives
    assert misses.any()
    assert np.isfinite(lesson.rows).all()


@pytest.mark.parametrize("known", [True, False], ids=["model", "none"])
def test_where_no_search_left_cells_they_are_cut_around_the_box(frame, model, known):
    lesson, own, misses, background = near(frame, model if known else None)
    assert own.sum() == 1 + SETTINGS.teaching.copies
    assert misses.any()
    assert background.sum() == SETTINGS.teaching.near_negatives
    scored = search.scored_around(frame, BOX, 20, model)
    assert scored.scores.shape == (20 - WINDOW + 1,) * 2
    assert len(places(scored, lesson.rows[~own])) > 20


def test_cells_of_a_narrow_search_are_not_enough(frame, model):
    narrow = search.scored_around(frame, BOX, 12, model)
    for one, other in zip(near(frame, model, narrow), near(frame, model), strict=True):
        np.testing.assert_array_equal(getattr(one, "rows", one), getattr(other, "rows", other))
