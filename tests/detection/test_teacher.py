"""The teacher: which windows and changed copies of them are training rows, and their labels."""

import numpy as np
import pytest

from catstream.base.box import Window
from catstream.base.settings import Settings
from catstream.detection import teacher
from catstream.detection.context import FrameContext
from catstream.detection.teacher import affine_copies
from catstream.features.cells import Cells
from catstream.features.layout import COLOURS, ROW_LENGTH, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap
from catstream.wire.heads import APPEARANCE, EXTENT
from catstream.wire.messages import Model

OBJECT = Window(120, 80, 64, 64)
SETTINGS = Settings()


@pytest.fixture
def frame(texture):
    return Pyramid(texture(240, 320, 12))


@pytest.fixture
def model(rng):
    return Model(1, 0, rng.normal(size=ROW_LENGTH).astype(np.float32), 0.0)


def cut(frame, model, around=None, window=OBJECT):
    """Training rows of group "appearance", and which of them are the object, near misses and background."""
    rows = teacher.training_at(FrameContext(frame, model, SETTINGS, 3), window, around)[APPEARANCE]
    own = rows.labels == 1
    return rows, own, (rows.labels > 0) & ~own, rows.labels == 0


def test_label_of_a_near_miss_is_a_gaussian_of_its_distance(frame, model, monkeypatch):
    monkeypatch.setattr(teacher, "_NEAR_MISSES", 200)
    around = ScoreMap.around(frame, OBJECT, 20, model)
    window = OBJECT.centred(OBJECT.centre[0] + 4, OBJECT.centre[1] - 3)  # half a cell of 8 pixels, and less
    rows, _, misses, _ = cut(frame, model, around, window)
    row, column = around.position(window)
    distances = {
        around.cells.row(*place).tobytes(): np.hypot(place[0] - row, place[1] - column)
        for place in np.ndindex(around.scores.shape)
    }
    near = [distances[features.tobytes()] for features in rows.rows[misses]]
    assert len(near) > 100
    assert 0.9 < min(near) < max(near) < 4
    np.testing.assert_allclose(rows.labels[misses], np.exp(-((np.array(near) / 0.9) ** 2) / 2), rtol=1e-5)


def test_background_is_distant_and_has_the_highest_score(frame, model):
    around = ScoreMap.around(frame, OBJECT, 20, model)
    rows, _, _, background = cut(frame, model, around)
    assert background.sum() == 12
    cuts = {features.tobytes() for features in rows.rows[background]}
    cells = [cell for cell in np.ndindex(around.scores.shape) if around.cells.row(*cell).tobytes() in cuts]
    distances = np.abs(np.subtract([*np.ndindex(13, 13)], 6)).max(axis=1).reshape(13, 13)
    assert all(distances[cell] > 2 for cell in cells)
    assert np.unravel_index(np.where(distances > 2, around.scores, -np.inf).argmax(), (13, 13)) in cells


def test_object_at_the_edge_of_the_search_area_has_all_rows(frame, model):
    around = ScoreMap.around(frame, OBJECT, 20, model)
    edge = around.window(0, 12)
    rows, own, misses, background = cut(frame, model, around, edge)
    assert own.sum() == 1 + SETTINGS.training.copies
    assert background.sum() == 12
    assert misses.any()
    assert np.isfinite(rows.rows).all()


def test_wrong_extent_is_labelled_with_a_gaussian_of_its_steps(frame, model):
    settings = SETTINGS.replace({"extent.size_count": 5})
    training = teacher.training_at(FrameContext(frame, model, settings, 3), OBJECT)
    own = Cells.within(frame.around(OBJECT, WINDOW)).row(0, 0)
    extents = training[EXTENT]
    np.testing.assert_array_equal(extents.rows[0], own)
    np.testing.assert_array_equal(training[APPEARANCE].rows[0], own)
    assert extents.labels == pytest.approx([1, *np.exp([-2, -0.5, -0.5, -2] * 2)])
    assert all(np.abs(row - own).max() > 0.01 for row in extents.rows[1:])
    for column, steps in enumerate(([0, -2, -1, 1, 2, 0, 0, 0, 0], [0, 0, 0, 0, 0, -2, -1, 1, 2])):
        assert extents.offsets[:, column] == pytest.approx([0.5 + k / 16 for k in steps])


def test_extent_that_is_not_learned_has_no_rows(frame, model):
    settings = SETTINGS.replace({"extent.learned": False})
    assert set(teacher.training_at(FrameContext(frame, model, settings, 3), OBJECT)) == {APPEARANCE}


def test_hard_negatives_score_high_and_exclude_the_object(frame, model):
    rows = teacher.hard_negatives(FrameContext(frame, model, SETTINGS), OBJECT)
    scores = rows.rows @ model.weights
    assert 0 < len(rows) <= SETTINGS.training.hard_negatives
    assert list(scores) == sorted(scores, reverse=True)
    assert not rows.labels.any()
    own = Cells.within(frame.around(OBJECT, WINDOW)).row(0, 0)
    assert min(np.abs(rows.rows - own).max(axis=1)) > 0.01


def test_disabled_colours_are_zero_in_every_row(frame, model):
    for used in (True, False):
        settings = SETTINGS.replace({"training.colours": used})
        first, training = teacher.first_training(frame, OBJECT, np.random.default_rng(1), settings)
        groups = [*training.values(), *teacher.training_at(FrameContext(frame, model, settings, 3), OBJECT).values()]
        assert all(group.rows[:, COLOURS].any() == used for group in groups)
        assert first.weights[COLOURS].any() == used


BOX = Window(64, 48, 64, 64)


def copies(image, window, count, seed=0, **how):
    return affine_copies(Pyramid(image), window, count, np.random.default_rng(seed), **how)


@pytest.mark.parametrize("moved", [0.0, 0.5])
def test_copies_depend_on_the_seed_and_begin_with_the_window(image, moved):
    one, two = (copies(image, BOX, 5, 7, moved=moved) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one[0], Cells.of(image).row(6, 8))
    assert np.abs(one[1:] - one[0]).max(axis=1).min() > 0


@pytest.mark.parametrize(("moved", "changed"), [(0.0, 0), (0.25, 2), (0.5, 4), (1.0, 8)])
def test_share_of_the_copies_has_another_background(rng, moved, changed):
    image = np.full((200, 240, 3), 60, np.uint8)
    image[:, 128:] = 250  # right of the box
    image[60:100, 76:116] = rng.integers(0, 256, (40, 40, 3), np.uint8)
    plain = copies(image, BOX, 9)
    rows = copies(image, BOX, 9, moved=moved)
    differ = np.abs(rows - plain).max(axis=1) > 0.5
    assert not differ[0]
    assert differ.sum() <= changed
    assert (changed == 0) or differ.any()


def test_object_keeps_its_centre_on_another_background(rng):
    image = rng.integers(0, 256, (200, 240, 3), np.uint8)
    image[40:120, 56:136] = 60
    plain, moved = (copies(image, BOX, 2, moved=share)[1].copy() for share in (0.0, 1.0))
    grids = [row[: 8 * 8 * 34].reshape(8, 8, 34) for row in (plain, moved)]
    np.testing.assert_allclose(grids[0][3:5, 3:5], grids[1][3:5, 3:5], atol=1e-3)


def test_last_copies_are_mirrored_but_never_the_window(image):
    plain, some = (copies(image, BOX, 6, mirrored=count) for count in (0, 2))
    np.testing.assert_array_equal(some[:4], plain[:4])
    np.testing.assert_allclose(some[4:, COLOURS], plain[4:, COLOURS], atol=1e-6)
    ours, theirs = (rows[4:, : COLOURS.start].reshape(2, 8, 8, 34)[..., 31:] for rows in (some, plain))
    np.testing.assert_allclose(ours, theirs[:, :, ::-1], atol=1e-5)
    np.testing.assert_array_equal(copies(image, BOX, 2, mirrored=9)[0], copies(image, BOX, 1)[0])
