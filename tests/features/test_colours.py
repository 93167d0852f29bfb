"""Colours: what the histogram of a window counts, and what it does not see."""

import cv2
import numpy as np
import pytest

from catstream.features import colours
from catstream.features.layout import SHADES
from catstream.features.pyramid import planes_of


def shades(image):
    return colours.shades(planes_of(image))


def colour_features(image, row=0, column=0):
    features = np.empty(SHADES, np.float32)
    colours.count(shades(image), row, column, features)
    return features


def test_a_shade_is_the_lab_colour_in_levels(rng):
    image = cv2.resize(rng.integers(0, 256, (20, 20, 3), np.uint8), (40, 40), interpolation=cv2.INTER_NEAREST)
    lab = cv2.cvtColor(image[::2, ::2] // 8 * 8 + 4, cv2.COLOR_BGR2LAB).astype(int)
    light, a, b = lab[..., 0] // 32, *((lab[..., k] - 98) // 10 for k in (1, 2))
    expected = (light * 6 + a.clip(0, 5)) * 6 + b.clip(0, 5)
    np.testing.assert_array_equal(shades(image), expected)


def test_a_histogram_is_the_root_of_shares_in_the_middle_6_by_6_cells():
    image = np.zeros((64, 64, 3), np.uint8)
    image[8:56, 8:20] = 255  # a quarter of the middle
    features = colour_features(image)
    assert sorted(features[features > 0]) == pytest.approx([3 * np.sqrt(0.25), 3 * np.sqrt(0.75)])


def test_neither_the_place_of_a_colour_nor_the_edge_of_the_image_changes_the_features(rng):
    image = np.repeat(np.repeat(rng.integers(0, 256, (32, 32, 3), np.uint8), 2, axis=0), 2, axis=1)
    turned = image.copy()
    turned[8:56, 8:56] = np.rot90(image[8:56, 8:56])
    turned[:8] = 0
    np.testing.assert_array_equal(colour_features(image), colour_features(turned))


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 255)])
def test_every_colour_has_a_shade(colour):
    found = shades(np.full((4, 4, 3), colour, np.uint8))
    assert (found < SHADES).all()


@pytest.mark.parametrize("writeable", [True, False], ids=["learned", "received"])
def test_scores_are_added_for_each_window(rng, writeable):
    image = np.repeat(np.repeat(rng.integers(0, 256, (24, 32, 3), np.uint8), 4, axis=0), 4, axis=1)
    weights = rng.normal(size=SHADES).astype(np.float32)
    weights.flags.writeable = writeable
    scores = np.full((5, 9), 7, np.float32)
    colours.add_scores(shades(image), weights, scores)
    expected = [[7 + colour_features(image, row, column) @ weights for column in range(9)] for row in range(5)]
    np.testing.assert_allclose(scores, expected, atol=1e-4)


def test_no_histogram_scores_higher_than_the_highest_score(rng):
    image = np.repeat(np.repeat(rng.integers(0, 256, (16, 16, 3), np.uint8), 4, axis=0), 4, axis=1)
    for weights in rng.normal(size=(20, SHADES)).astype(np.float32):
        assert colour_features(image) @ weights <= colours.highest_score(weights)
    own = colour_features(image)
    assert own @ own == pytest.approx(colours.highest_score(own), rel=1e-5)


def test_windows_with_a_lower_score_are_left_out(rng):
    image = np.repeat(np.repeat(rng.integers(0, 256, (24, 32, 3), np.uint8), 4, axis=0), 4, axis=1)
    weights, given = rng.normal(size=SHADES).astype(np.float32), rng.normal(size=(5, 9)).astype(np.float32)
    every, some = given.copy(), given.copy()
    colours.add_scores(shades(image), weights, every)
    colours.add_scores(shades(image), weights, some, 0.0)
    np.testing.assert_allclose(some, np.where(given < 0, given, every), atol=1e-4)
