"""The pyramid of a frame."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Window
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid, Region, planes_of, reduced


@pytest.mark.parametrize(("scale", "width"), [(0.3, 1), (1.99, 1), (2.0, 2), (3.9, 2), (4.0, 4), (9.0, 8)])
def test_pixel_width_is_the_power_of_two_up_to_the_scale(rng, scale, width):
    image = rng.integers(0, 256, (64, 96), np.uint8)
    small, step = Pyramid(image).near(scale)
    blocks = image.reshape(64 // width, width, 96 // width, width).astype(float)
    assert step == width
    assert np.abs(small - blocks.mean(axis=(1, 3))).max() <= 1.5, "each halving rounds"


def test_tiny_frame_is_halved_to_one_pixel_at_least(rng):
    image, width = Pyramid(rng.integers(0, 256, (7, 5), np.uint8)).near(1000)
    assert min(image.shape) == 1
    assert width <= 7


def test_cut_at_its_own_scale_is_a_slice(image):
    np.testing.assert_array_equal(Pyramid(image).cut(100, 80, 1, 1, 64), planes_of(image[48:112, 68:132]))


@pytest.mark.parametrize("zoom", [0.5, 1.7, 3.0, 7.5])
def test_cut_shows_the_same_place_at_every_scale(zoom):
    ramp = np.add.outer(np.arange(600), np.arange(800)).astype(np.float32)
    image = (ramp / ramp.max() * 255).astype(np.uint8)
    patch = Pyramid(image).cut(400, 300, zoom, zoom, 64)[0].astype(float)
    expected = (700 + np.add.outer(np.arange(64) - 31.5, np.arange(64) - 31.5) * zoom - 1) / ramp.max() * 255
    inside = (expected > 3) & (expected < 250)
    assert np.abs(patch - expected)[inside].max() < 2.5


@pytest.mark.parametrize("turn", [0, 1e-12], ids=["straight", "turned"])
@pytest.mark.parametrize("grey", [False, True], ids=["colour", "grey"])
@pytest.mark.parametrize(("x", "y"), [(100.3, 80.9), (2.2, 199.6), (-70, 301.7)], ids=["inside", "edge", "beyond"])
def test_cut_interpolates_between_pixels(image, x, y, grey, turn):
    image = cv2.GaussianBlur(image[:, :, 0] if grey else image, (0, 0), 1)
    patch = Pyramid(image).cut(x, y, 0.7, 1.3, 48, turn)
    columns, rows = (at - 0.5 + (np.arange(48) - 23.5) * step for at, step in ((x, 0.7), (y, 1.3)))
    where = np.broadcast_arrays(columns[None], rows[:, None])
    expected = cv2.remap(image.astype(np.float32), *np.float32(where), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    expected = np.atleast_3d(expected).transpose(2, 0, 1)
    assert np.abs(patch - expected).max() < 3, "OpenCV knows 32 places between two pixels"
    assert np.abs(patch - expected).mean() < 0.5


REGIONS = st.builds(Region, st.integers(0, 99), st.integers(0, 99), st.integers(40, 4000), st.integers(40, 4000))
WINDOWS = st.builds(Window, st.just(0.0), st.just(0.0), st.floats(6, 300), st.floats(6, 300))


@given(REGIONS, WINDOWS, st.integers(400, 20_000), st.floats(0, 1), st.floats(0, 1))
def test_each_window_of_a_region_lies_in_one_of_its_parts(region, window, most, across, down):
    parts = region.split(window, most)
    x = region.left + across * max(region.width - window.w, 0)
    y = region.top + down * max(region.height - window.h, 0)
    assert any(
        part.left <= x
        and part.top <= y
        and min(x + window.w, region.left + region.width) <= part.left + part.width
        and min(y + window.h, region.top + region.height) <= part.top + part.height
        for part in parts
    )


@given(REGIONS, WINDOWS, st.integers(400, 20_000))
def test_part_has_at_most_the_allowed_cells(region, window, most):
    for part in region.split(window, most):
        inner = part._replace(width=part.width - 1, height=part.height - 1)
        assert inner.cells(window) <= most
        assert region.left <= part.left <= part.left + part.width <= region.left + region.width
        assert region.top <= part.top <= part.top + part.height <= region.top + region.height


def test_part_of_a_frame_has_the_same_pixels(image):
    frame = Pyramid(image)
    np.testing.assert_array_equal(frame.part(Region(30, 20, 100, 50)).image, image[20:70, 30:130])
    assert frame.part(frame.region) is frame


def test_region_around_a_tiny_window_has_a_constant_size():
    frame, window = Pyramid(np.zeros((600, 800, 3), np.uint8)), Window(396, 296, 8, 8)
    region = frame.region_around(window)
    assert 62_000 < region.cells(window) <= 62_500
    assert 2 * region.left + region.width == pytest.approx(800, abs=2)
    assert frame.region_around(window.scaled(WINDOW)) == frame.region


@pytest.mark.parametrize("size", [(400, 300), (638, 479), (333, 96), (120, 241), (320, 240), (64, 64)])
def test_reduced_image_is_that_of_opencv(rng, size):
    image = rng.integers(0, 256, (481, 640, 3), np.uint8)
    np.testing.assert_array_equal(reduced(image, size), cv2.resize(image, size, interpolation=cv2.INTER_AREA))
