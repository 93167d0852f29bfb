"""Laws of CoresetPCA: the interface of scikit-learn, and its error compared with a PCA of all rows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.decomposition import PCA
from sklearn.utils.estimator_checks import check_estimator

from catstream.sketch import CoresetPCA

ROUNDING = 1e-5  # of float32, relative to the total variance


@pytest.fixture
def rows(rng):
    """Rows far from zero, float64 (900, 40), of which some directions vary more."""
    return rng.normal(size=(900, 40)) @ (rng.normal(size=(40, 40)) * np.linspace(3, 0.1, 40)[:, None]) + 1000


def lost(pca, rows):
    """Squared reconstruction error."""
    return np.sum((pca.inverse_transform(pca.transform(rows)) - rows) ** 2)


def assert_same(one, other):
    assert one.n_samples_seen_ == other.n_samples_seen_
    assert_allclose(one.mean_, other.mean_, rtol=1e-12)
    assert_allclose(one.explained_variance_, other.explained_variance_, rtol=ROUNDING)
    assert_allclose(abs(one.components_ @ other.components_.T), np.eye(len(one.components_)), atol=1e-3)


def test_scikit_learn_accepts_the_estimator():
    check_estimator(CoresetPCA(), on_skip=None)


@pytest.mark.parametrize("size", [40, 128])
def test_rows_no_longer_than_a_node_give_the_exact_pca(rows, size):
    pca, exact = CoresetPCA(5, size).fit(rows), PCA(5).fit(rows)
    assert_allclose(pca.components_, exact.components_, atol=1e-4)
    for name in ("mean_", "explained_variance_", "explained_variance_ratio_", "singular_values_"):
        assert_allclose(getattr(pca, name), getattr(exact, name), rtol=ROUNDING)


def test_excess_error_is_at_most_the_dropped_energy(rows):
    pca, exact = CoresetPCA(5, size=16).fit(rows), PCA(5).fit(rows)
    assert pca.tree_.dropped_energy > 0
    slack = ROUNDING * pca.tree_.energy
    assert -slack <= lost(pca, rows) - lost(exact, rows) <= pca.tree_.dropped_energy + slack


@pytest.mark.parametrize("cuts", [[1, 2, 3], [500]], ids=["rows", "halves"])
def test_stream_in_parts_is_fitted_as_one(rows, cuts):
    parts = CoresetPCA(5, size=16)
    for part in np.split(rows, cuts):
        parts.partial_fit(part)
    assert_same(parts, CoresetPCA(5, size=16).fit(rows))


def test_two_estimators_merged_are_one_of_all_rows(rows):
    merged = CoresetPCA(5, size=64).fit(rows[:300]).merge(CoresetPCA(5, size=64).fit(rows[300:] + 7))
    assert_same(merged, CoresetPCA(5, size=64).fit(np.vstack([rows[:300], rows[300:] + 7])))


def test_estimators_of_other_columns_are_not_merged(rows):
    def fitted(*names):
        pca = CoresetPCA(2).fit(rows[:, : len(names)])
        pca.feature_names_in_ = np.array(names)  # as of a data frame
        return pca

    fitted("x", "y", "z").merge(fitted("x", "y", "z"))
    for other in (fitted("x", "z", "y"), fitted("x", "y", "u"), fitted("x", "y"), CoresetPCA(2).fit(rows[:, :2])):
        with pytest.raises(ValueError, match="cannot merge"):
            fitted("x", "y", "z").merge(other)


@pytest.mark.parametrize("size", [16, 64])
@pytest.mark.parametrize("scale", [1e-35, 1e-25, 1e17, 1e33])
def test_components_do_not_depend_on_the_unit_of_the_rows(rows, size, scale):
    right, scaled = (CoresetPCA(5, size).fit((rows - 1000) * unit) for unit in (1.0, scale))
    assert_allclose(scaled.explained_variance_ratio_, right.explained_variance_ratio_, rtol=ROUNDING)
    assert_allclose(abs(scaled.components_ @ right.components_.T), np.eye(5), atol=1e-3)


def test_components_are_orthonormal_and_fewer_than_rows_are(rows):
    pca = CoresetPCA(5).partial_fit(rows[:3])
    assert pca.components_.shape == (3, 40)
    for more in (rows[:1], np.repeat(rows[:1], 300, axis=0)):
        pca = CoresetPCA(5).fit(more)
        assert_allclose(pca.components_ @ pca.components_.T, np.eye(pca.n_components_), atol=1e-12)
        assert_allclose(pca.explained_variance_, 0, atol=ROUNDING)
        assert np.isfinite(pca.explained_variance_ratio_).all()


@pytest.mark.parametrize("n_components", [0, 17, 41])
def test_number_of_components_beyond_a_node_is_an_error(rows, n_components):
    with pytest.raises(ValueError, match=rf"n_components={n_components} is not between 1 and .*=16: choose fewer"):
        CoresetPCA(n_components, size=16).fit(rows)
