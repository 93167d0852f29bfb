"""Affine copies: slightly changed, and some of them on another background."""

import numpy as np
import pytest

from catstream.box import Window
from catstream.detection.teacher import affine_copies
from catstream.features.cells import Cells
from catstream.features.layout import COLOURS
from catstream.features.pyramid import Pyramid

WINDOW = Window(64, 48, 64, 64)


def copies(image, window, count, seed=0, **how):
    return affine_copies(Pyramid(image), window, count, np.random.default_rng(seed), **how)


@pytest.mark.parametrize("moved", [0.0, 0.5])
def test_copies_are_seeded_and_the_first_is_the_window(image, moved):
    one, two = (copies(image, WINDOW, 5, 7, moved=moved) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one[0], Cells.of(image).row(6, 8))
    assert np.abs(one[1:] - one[0]).max(axis=1).min() > 0


@pytest.mark.parametrize(("moved", "changed"), [(0.0, 0), (0.25, 2), (0.5, 4), (1.0, 8)])
def test_a_share_of_them_is_put_on_another_background(rng, moved, changed):
    image = np.full((200, 240, 3), 60, np.uint8)
    image[:, 128:] = 250  # beside the box
    image[60:100, 76:116] = rng.integers(0, 256, (40, 40, 3), np.uint8)
    plain = copies(image, WINDOW, 9, context=1.25)
    rows = copies(image, WINDOW, 9, context=1.25, moved=moved)
    differ = np.abs(rows - plain).max(axis=1) > 0.5
    assert not differ[0]
    assert differ.sum() <= changed
    assert (changed == 0) or differ.any()


def test_on_another_background_the_object_keeps_its_centre(rng):
    image = rng.integers(0, 256, (200, 240, 3), np.uint8)
    image[40:120, 56:136] = 60
    plain, moved = (copies(image, WINDOW, 2, context=1.25, moved=share)[1].copy() for share in (0.0, 1.0))
    grids = [row[: 8 * 8 * 34].reshape(8, 8, 34) for row in (plain, moved)]
    np.testing.assert_allclose(grids[0][3:5, 3:5], grids[1][3:5, 3:5], atol=1e-3)


def test_the_last_copies_are_mirrored_and_never_the_window_itself(image):
    plain, some = (copies(image, WINDOW, 6, mirrored=count) for count in (0, 2))
    np.testing.assert_array_equal(some[:4], plain[:4])
    np.testing.assert_allclose(some[4:, COLOURS], plain[4:, COLOURS], atol=1e-6)
    ours, theirs = (rows[4:, : COLOURS.start].reshape(2, 8, 8, 34)[..., 31:] for rows in (some, plain))
    np.testing.assert_allclose(ours, theirs[:, :, ::-1], atol=1e-5)
    np.testing.assert_array_equal(copies(image, WINDOW, 2, mirrored=9)[0], copies(image, WINDOW, 1)[0])
