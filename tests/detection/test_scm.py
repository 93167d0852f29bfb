"""The paper's own parts: the sparse collaborative model alone, and the one-class support vector machine."""

import itertools
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.decomposition import sparse_encode
from sklearn.svm import OneClassSVM

from catstream.base.box import Box
from catstream.detection import scm
from catstream.detection.scm import SparseCollaborativeModel
from catstream.errors import ProtocolError
from catstream.training.one_class import one_class

START = Box(60, 50, 48, 40)


def followed(frames, start, seed=0):
    frames = iter(frames)
    model = SparseCollaborativeModel(next(frames), start, np.random.default_rng(seed), particles=100)
    return [model.track(frame) for frame in frames]


@pytest.mark.parametrize("centre", [0.0, 1.0])
def test_codes_are_those_of_scikit_learn(rng, centre):
    """Also of atoms that are nearly alike, as patches of a picture are."""
    atoms, rows = (scm._unit(rng.normal(centre, 0.5, size=(count, 36))) for count in (50, 40))
    codes = scm._codes(rows, atoms)
    exact = [array.astype(np.float64) for array in (rows, atoms)]
    expected = sparse_encode(*exact, algorithm="lasso_cd", alpha=scm._PENALTY, positive=True, max_iter=100_000)
    assert codes.min() == 0
    np.testing.assert_allclose(codes, expected, atol=1e-3)


def test_half_covered_object_is_tracked(scene):
    ways = [((60 + 2 * i, 50 + i), 0.4 if 4 <= i < 12 else 0.0) for i in range(16)]
    found = followed(itertools.starmap(scene, ways), START)
    overlaps = [box.overlap(Box(*at, 48, 40)) for (_, box), (at, _) in zip(found, ways[1:], strict=True)]
    assert min(overlaps) > 0.5


def test_score_falls_if_the_object_is_absent(scene):
    (there, _), (gone, _) = followed([scene((60, 50)), scene((62, 51)), scene((250, 180))], START)
    assert there > 0.6 > 0.5 > gone


def test_training_in_threads_keeps_the_filters_of_warnings(rng):
    cuts = rng.integers(0, 256, (2, 20, 32, 32), np.uint8)
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: scm._Discriminative.trained(*cuts), range(20)))
    assert warnings.filters == before


def test_boxes_depend_on_the_seed_only(scene):
    frames = [scene((60 + 3 * i, 50 + 2 * i)) for i in range(7)]
    assert followed(frames, START, seed=1) == followed(frames, START, seed=1) != followed(frames, START, seed=2)


def test_frame_without_contrast_has_a_finite_score():
    ((score, box),) = followed(np.zeros((2, 120, 160, 3), np.uint8), START)
    assert np.isfinite([score, *box]).all()


def test_box_of_a_leaving_object_has_its_centre_in_the_frame(scene):
    frames = [np.roll(scene((60, 50)), -8 * i, axis=1)[:, :160] for i in range(12)]
    assert all(0 <= box.centre[0] < 160 for _, box in followed(frames, START))


def rows_around(mean: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    return (mean + rng.normal(scale=0.1, size=(count, len(mean)))).astype(np.float32)


@pytest.fixture
def background(rng) -> np.ndarray:
    return rows_around(rng.uniform(size=300), 400, rng)


@pytest.fixture
def rows(rng) -> np.ndarray:
    return rows_around(rng.uniform(size=300), 96, rng)


@pytest.mark.parametrize("nu", [0.05, 0.95])
def test_one_class_model_decides_as_the_linear_kernel(rows, background, nu):
    origin = background.mean(axis=0)
    machine = OneClassSVM(kernel="linear", nu=nu).fit(rows - origin)
    expected = machine.decision_function(background - origin) + machine.offset_
    assert_allclose((background - origin) @ one_class(rows, origin, nu), expected, rtol=1e-5, atol=1e-5 * len(rows))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_rows_equal_to_the_background_are_an_error(background, count):
    origin = background.mean(axis=0)
    with pytest.raises(ProtocolError, match="differs from the background"):
        one_class(np.tile(origin, (count, 1)), origin)
