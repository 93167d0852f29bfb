"""The pyramid of a frame."""

import numpy as np
import pytest

from catstream.detection.pyramid import Pyramid


@pytest.mark.parametrize(("scale", "wide"), [(0.3, 1), (1.99, 1), (2.0, 2), (3.9, 2), (4.0, 4), (9.0, 8)])
def test_a_pixel_is_as_wide_as_may_be_and_no_wider(rng, scale, wide):
    image, step = Pyramid(rng.integers(0, 256, (64, 96, 3), np.uint8)).near(scale)
    assert step == wide
    assert image.shape == (64 // wide, 96 // wide, 3)


def test_a_pixel_is_the_mean_of_those_that_it_stands_for(rng):
    image = rng.integers(0, 256, (48, 56), np.uint8)
    small, wide = Pyramid(image).near(4)
    blocks = image.reshape(12, wide, 14, wide).astype(float)
    assert np.abs(small - blocks.mean(axis=(1, 3))).max() <= 1, "each halving rounds"


def test_what_was_made_is_not_made_again(rng):
    pyramid = Pyramid(rng.integers(0, 256, (64, 96, 3), np.uint8))
    assert pyramid.near(5)[0] is pyramid.near(4)[0]
    assert pyramid.near(1)[0] is pyramid.image


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 5)])
def test_a_tiny_frame_is_never_halved_away(rng, shape):
    image, wide = Pyramid(rng.integers(0, 256, shape, np.uint8)).near(1000)
    assert min(image.shape) == 1
    assert wide <= max(shape)
