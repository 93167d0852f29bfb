"""Cells: HOG, mean colours and histograms of colours; rows and scores of every window; and their kernels."""

import cv2
import numpy as np
import pytest
from numba import config

from catstream.features import cells as features
from catstream.features import compilation
from catstream.features.cells import Cells
from catstream.features.compilation import COMPILING
from catstream.features.layout import CELL, CHANNELS, COLOURS, MARGIN, ROW_LENGTH, SHADES
from catstream.features.pyramid import planes_of


@pytest.fixture
def cells(rng):
    small = rng.integers(0, 256, (22, 28, 3), np.uint8)
    return Cells.of(np.repeat(np.repeat(small, 4, axis=0), 4, axis=1))


def test_score_of_a_window_is_weights_times_row_plus_bias(cells, rng):
    weights = rng.normal(size=ROW_LENGTH).astype(np.float32)
    weights.flags.writeable = False  # like the weights of a message
    scores = cells.respond(weights, 0.5)
    expected = [[cells.row(row, column) @ weights + 0.5 for column in range(7)] for row in range(4)]
    np.testing.assert_allclose(scores, expected, rtol=1e-4, atol=1e-3)


def test_row_is_the_cells_of_the_window_and_then_its_colours(cells):
    row = cells.row(2, 3)
    assert (row.shape, row.dtype) == ((ROW_LENGTH,), np.float32)
    np.testing.assert_array_equal(row[: COLOURS.start], cells.grid[2:10, 3:11].ravel())
    assert np.linalg.norm(row[COLOURS]) == pytest.approx(3, abs=1e-5)


@pytest.mark.parametrize("quantile", [0.0, 0.5, 0.9, 1.0])
def test_scores_above_a_threshold_are_those_of_all_windows(cells, rng, quantile):
    weights = rng.normal(size=ROW_LENGTH).astype(np.float32)
    scores = cells.respond(weights, 0.5)
    least = float(np.quantile(scores, quantile)) + 1e-3
    expected = np.where(scores >= least, scores, -np.inf)
    np.testing.assert_allclose(cells.respond_above(weights, 0.5, least), expected, rtol=1e-4, atol=1e-3)


@pytest.fixture
def soft(rng):
    noise = rng.integers(0, 256, (120, 168, 3), np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)


def grid(image, margin=0):
    return features.grid(planes_of(image), margin)


def plain_hog(image):
    """The published definition (Felzenszwalb et al. 2010), one pixel at a time."""
    rows, columns = image.shape[0] // CELL, image.shape[1] // CELL
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
    return out


def test_hog_is_the_published_definition(soft):
    np.testing.assert_allclose(grid(soft[:48, :64])[:, :, :31], plain_hog(soft[:48, :64]), atol=2e-4)


def test_features_of_a_crop_equal_the_slice_of_the_frames_grid(soft):
    crop = soft[2 * CELL : 12 * CELL, 5 * CELL : 17 * CELL]
    expected = grid(soft)[2 + MARGIN : 12 - MARGIN, 5 + MARGIN : 17 - MARGIN]
    np.testing.assert_array_equal(grid(crop)[MARGIN:-MARGIN, MARGIN:-MARGIN], expected)
    np.testing.assert_array_equal(grid(crop, MARGIN), expected)


def test_colour_channels_tell_red_from_green():
    red, green = (np.full((64, 64, 3), colour, np.uint8) for colour in ((0, 0, 200), (0, 200, 0)))
    assert np.abs(grid(red)[0, 0, 31:] - grid(green)[0, 0, 31:]).max() > 1
    np.testing.assert_allclose(grid(np.full((64, 64, 3), 128, np.uint8))[:, :, 32:], 0, atol=1e-6)


@pytest.mark.parametrize(("height", "width"), [(7, 100), (64, 64), (65, 71), (8, 8), (33, 9)])
def test_any_size_gives_its_whole_cells(height, width, rng):
    cells = grid(rng.integers(0, 256, (height, width, 3), np.uint8))
    assert cells.shape == (height // 8, width // 8, CHANNELS)
    assert np.isfinite(cells).all()


def colour_features(image, row=0, column=0):
    return Cells.of(image).row(row, column)[COLOURS]


def test_histogram_is_the_root_of_shares_in_the_middle_cells():
    image = np.zeros((64, 64, 3), np.uint8)
    image[8:56, 8:20] = 255  # a quarter of the middle
    found = colour_features(image)
    assert sorted(found[found > 0]) == pytest.approx([3 * np.sqrt(0.25), 3 * np.sqrt(0.75)])


def test_histogram_depends_neither_on_positions_nor_on_the_border(rng):
    image = np.repeat(np.repeat(rng.integers(0, 256, (32, 32, 3), np.uint8), 2, axis=0), 2, axis=1)
    turned = image.copy()
    turned[8:56, 8:56] = np.rot90(image[8:56, 8:56])
    turned[:8] = 0
    np.testing.assert_array_equal(colour_features(image), colour_features(turned))


def test_highest_colour_score_bounds_the_score_of_histograms(rng):
    image = np.repeat(np.repeat(rng.integers(0, 256, (16, 16, 3), np.uint8), 4, axis=0), 4, axis=1)
    for weights in rng.normal(size=(20, SHADES)).astype(np.float32):
        assert colour_features(image) @ weights <= features.highest_colour_score(weights)
    own = colour_features(image)
    assert own @ own == pytest.approx(features.highest_colour_score(own), rel=1e-5)


def test_lab_colours_are_those_of_opencv_within_one_level():
    levels = np.arange(0, 256, 3, np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    ours = features.lab(colours).astype(int)
    off = np.abs(ours - cv2.cvtColor(colours[None], cv2.COLOR_BGR2LAB)[0])
    assert off.max() <= 1
    assert np.mean(off > 0) < 1e-3


def doubled(array):
    for place in range(len(array)):
        array[place] *= 2


@pytest.fixture
def compiles(monkeypatch, caplog):
    """A function that makes a kernel with this folder as the cache, and returns True if it was compiled."""

    def make(folder):
        monkeypatch.setattr(config, "CACHE_DIR", str(folder))
        monkeypatch.setattr(config, "CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator")
        compilation._announce.cache_clear()
        caplog.clear()
        numbers = np.arange(3, dtype=np.uint8)
        compilation.kernel("void(uint8[:])")(doubled)(numbers)
        assert numbers.tolist() == [0, 2, 4]
        assert caplog.messages in ([], [COMPILING])
        return bool(caplog.messages)

    return make


def test_first_start_reports_compilation_and_repairs_a_damaged_cache(compiles, tmp_path):
    assert [compiles(tmp_path) for _ in range(2)] == [True, False]
    (file,) = tmp_path.rglob("*doubled*.nbi")
    file.write_bytes(b"")
    assert compiles(tmp_path)


def test_kernels_are_compiled_in_memory_without_a_writable_folder(compiles, tmp_path):
    (tmp_path / "file").touch()
    assert compiles(tmp_path / "file" / "folder")
