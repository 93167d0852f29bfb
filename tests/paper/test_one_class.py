"""The one-class support vector machine, against scikit-learn's own linear kernel."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.svm import OneClassSVM

from catstream.errors import ProtocolError
from catstream.paper.one_class import one_class


def rows_around(mean: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    return (mean + rng.normal(scale=0.1, size=(count, len(mean)))).astype(np.float32)


@pytest.fixture
def background(rng) -> np.ndarray:
    return rows_around(rng.uniform(size=300), 400, rng)


@pytest.fixture
def rows(rng) -> np.ndarray:
    return rows_around(rng.uniform(size=300), 96, rng)


@pytest.mark.parametrize("nu", [0.05, 0.5, 0.95])
def test_decides_as_the_linear_kernel_does(rows, background, nu):
    origin = background.mean(axis=0)
    machine = OneClassSVM(kernel="linear", nu=nu).fit(rows - origin)
    expected = machine.decision_function(background - origin) + machine.offset_
    assert_allclose((background - origin) @ one_class(rows, origin, nu), expected, rtol=1e-5, atol=1e-5 * len(rows))


def test_features_shared_by_object_and_background_do_not_count(rows, background):
    """Adding the same edges to everything leaves the direction as it was."""
    edges = np.linspace(0, 1, rows.shape[1], dtype=np.float32)
    plain = one_class(rows, background.mean(axis=0))
    edged = one_class(rows + edges, (background + edges).mean(axis=0))
    assert_allclose(edged / np.linalg.norm(edged), plain / np.linalg.norm(plain), atol=1e-4)


def test_same_rows_same_bits(rows, background):
    first, second = (one_class(rows.copy(), background.mean(axis=0)) for _ in range(2))
    assert first.dtype == np.float32
    assert_array_equal(first, second)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_rows_equal_to_the_background_are_rejected(background, count):
    origin = background.mean(axis=0)
    with pytest.raises(ProtocolError, match="differs from the background"):
        one_class(np.tile(origin, (count, 1)), origin)
