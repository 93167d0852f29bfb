"""Features of an image."""

import cv2
import numpy as np
import pytest

from catstream.features import hog
from catstream.features.layout import CELL, CHANNELS, MARGIN
from catstream.features.pyramid import planes_of


@pytest.fixture
def image(rng):
    noise = rng.integers(0, 256, (120, 168, 3), np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)


def grid(image, margin=0):
    return hog.grid(planes_of(image), margin)


def plain_hog(image):
    """The published definition (Felzenszwalb et al. 2010), one pixel at a time."""
    height, width, rows, columns = *image.shape[:2], image.shape[0] // CELL, image.shape[1] // CELL
    wide = np.pad(image.astype(float), ((1, 1), (1, 1), (0, 0)), mode="edge")
    histogram = np.zeros((rows + 2, columns + 2, 18))
    for y in range(rows * CELL):
        for x in range(columns * CELL):
            dx, dy = wide[y + 1, x + 2] - wide[y + 1, x], wide[y + 2, x + 1] - wide[y, x + 1]
            strongest = np.argmax(dx**2 + dy**2)
            dx, dy = dx[strongest], dy[strongest]
            orientation = int(np.rint(np.float32(np.arctan2(np.float32(dy), np.float32(dx))) / (2 * np.pi) * 18)) % 18
            v, u = (y + 0.5) / CELL + 0.5, (x + 0.5) / CELL + 0.5
            for row, share_y in ((int(v), 1 - v % 1), (int(v) + 1, v % 1)):
                for column, share_x in ((int(u), 1 - u % 1), (int(u) + 1, u % 1)):
                    histogram[row, column, orientation] += np.hypot(dx, dy) * share_y * share_x
    histogram = histogram[1:-1, 1:-1]
    unsigned = histogram[:, :, :9] + histogram[:, :, 9:]
    energy = np.pad((unsigned**2).sum(axis=2), 1, mode="edge")
    out = np.zeros((rows, columns, 31))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        block = sum(energy[a : a + rows, b : b + columns] for a in (i, i + 1) for b in (j, j + 1))
        norm = 1 / np.sqrt(block + 1e-4)[:, :, None]
        signed = np.minimum(histogram * norm, 0.2)
        out[:, :, :18] += signed / 2
        out[:, :, 18:27] += np.minimum(unsigned * norm, 0.2) / 2
        out[:, :, 27 + 2 * i + j] = signed.sum(axis=2) * 0.2357
    assert height >= rows * CELL
    assert width >= columns * CELL
    return out


def test_hog_is_the_published_definition(image):
    np.testing.assert_allclose(grid(image[:48, :64])[:, :, :31], plain_hog(image[:48, :64]), atol=2e-4)


def test_features_of_a_crop_equal_the_slice_of_the_frames_grid(image):
    crop = image[2 * CELL : 12 * CELL, 5 * CELL : 17 * CELL]
    expected = grid(image)[2 + MARGIN : 12 - MARGIN, 5 + MARGIN : 17 - MARGIN]
    np.testing.assert_array_equal(grid(crop)[MARGIN:-MARGIN, MARGIN:-MARGIN], expected)
    np.testing.assert_array_equal(grid(crop, MARGIN), expected)


def test_light_added_everywhere_changes_no_gradient(image):
    dim = image // 2
    np.testing.assert_array_equal(grid(dim)[:, :, :31], grid(dim + 50)[:, :, :31])


def test_colour_channels_tell_red_from_green():
    red, green = (np.full((64, 64, 3), colour, np.uint8) for colour in ((0, 0, 200), (0, 200, 0)))
    assert np.abs(grid(red)[0, 0, 31:] - grid(green)[0, 0, 31:]).max() > 1
    np.testing.assert_allclose(grid(np.full((64, 64, 3), 128, np.uint8))[:, :, 32:], 0, atol=1e-6)


@pytest.mark.parametrize(("height", "width"), [(7, 100), (64, 64), (65, 71), (8, 8), (33, 9)])
def test_any_size_gives_its_whole_cells(height, width, rng):
    cells = grid(rng.integers(0, 256, (height, width, 3), np.uint8))
    assert cells.shape == (height // 8, width // 8, CHANNELS)
    assert np.isfinite(cells).all()
