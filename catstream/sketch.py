"""Estimators with the interface of scikit-learn, which learn from a stream of rows in a coreset tree."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils import check_array, gen_batches
from sklearn.utils.extmath import svd_flip
from sklearn.utils.validation import check_is_fitted, validate_data

from catstream.base.arrays import Float64
from catstream.base.threads import one_thread
from catstream.coreset.reduce import reduce
from catstream.coreset.tree import CoresetTree

_TYPES = (np.float64, np.float32)


class CoresetPCA(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Principal component analysis of a stream of rows, from a coreset tree.

    One pass, O(size d) time for each row on average, and O(size d log p) memory for p rows of d features. The squared
    reconstruction error of all rows exceeds that of a PCA of all rows by at most `tree_.dropped_energy`, and not at all
    if d <= size; both up to the rounding of float32, 1e-7 of the total variance.

    Rows are centred while they arrive: row k is inserted as `sqrt((k - 1) / k) (x - m)`, where m is the mean of the
    k - 1 rows before it. The products of these rows add up to the scatter matrix about the mean of all rows (Welford
    1962), so the bound of the tree holds for centred rows, and the result does not depend on how the stream is divided
    into calls of `partial_fit`, up to rounding.

    Parameters
    ----------
    n_components : number of components, at most `size`; None: the least of `size`, d and p
    size : number of rows of a node of the tree; more of them reduce the error, and the time of shorter rows

    Attributes
    ----------
    components_ : float64 (n_components_, d), orthonormal, strongest first
    explained_variance_ : variance along each component, too small by at most `tree_.dropped_energy / (p - 1)`
    explained_variance_ratio_ : the same, divided by the total variance, which is exact
    singular_values_ : of the centred rows
    n_components_ : number of components: at most d, and p
    mean_ : mean of all rows
    n_samples_seen_ : number of rows, p
    tree_ : the `CoresetTree` of the centred rows

    >>> rows = np.random.default_rng(0).normal(size=(500, 3)) * [5, 2, 0.1] + 40
    >>> pca = CoresetPCA(n_components=1).fit(rows[:200]).partial_fit(rows[200:])
    >>> pca.transform(rows).shape, pca.explained_variance_ratio_.round(1).tolist()
    ((500, 1), [0.9])
    """

    tree_: CoresetTree
    mean_: Float64
    n_samples_seen_: int

    def __init__(self, n_components: int | None = None, size: int = 256) -> None:
        self.n_components, self.size = n_components, size

    def fit(self, X: Any, y: Any = None) -> Self:  # noqa: ARG002  of a Pipeline
        """Fit the components to rows, (k, d); rows of earlier calls are forgotten."""
        self._insert(validate_data(self, X, dtype=_TYPES), begin=True)
        self._decomposition  # noqa: B018  other methods change no attribute
        return self

    def partial_fit(self, X: Any, y: Any = None) -> Self:  # noqa: ARG002
        """Add rows, (k, d); the components are computed when they are used next."""
        begin = not hasattr(self, "tree_")
        self._insert(validate_data(self, X, dtype=_TYPES, reset=begin), begin)
        return self

    def merge(self, other: CoresetPCA) -> Self:
        """Add the rows of another estimator of the same size; the bound holds as if one had received all rows.

        ValueError if its columns differ in number, names or order.
        """
        for estimator in (self, other):
            check_is_fitted(estimator)
        names, others = (getattr(estimator, "feature_names_in_", None) for estimator in (self, other))
        if names is not None and others is not None and not np.array_equal(names, others):
            raise ValueError(f"cannot merge the columns {[*others]} into {[*names]}: fit both to the same ones")
        tree, p, q = self.tree_.merged(other.tree_), self.n_samples_seen_, other.n_samples_seen_
        shift = other.mean_ - self.mean_
        tree.insert(np.sqrt(p * q / (p + q)) * shift[None])
        self.tree_, self.n_samples_seen_, self.mean_ = tree, p + q, self.mean_ + q / (p + q) * shift
        self.__dict__.pop("_decomposition", None)
        return self

    def transform(self, X: Any) -> Float64:
        """The coordinates of rows along the components, float64 (k, n_components_)."""
        check_is_fitted(self)
        coordinates: Float64 = (validate_data(self, X, dtype=_TYPES, reset=False) - self.mean_) @ self.components_.T
        return coordinates

    def inverse_transform(self, X: Any) -> Float64:
        """The rows with these coordinates in the span of the components, float64 (k, d)."""
        check_is_fitted(self)
        rows: Float64 = check_array(X, dtype=_TYPES) @ self.components_ + self.mean_
        return rows

    @property
    def components_(self) -> Float64:
        return self._decomposition[1]

    @property
    def singular_values_(self) -> Float64:
        return self._decomposition[0]

    @property
    def explained_variance_(self) -> Float64:
        return self.singular_values_**2 / max(self.n_samples_seen_ - 1, 1)

    @property
    def explained_variance_ratio_(self) -> Float64:
        return self.singular_values_**2 / (self.tree_.energy or 1)

    @property
    def n_components_(self) -> int:
        return len(self.singular_values_)

    @property
    def _n_features_out(self) -> int:
        return self.n_components_

    @cached_property
    def _decomposition(self) -> tuple[Float64, Float64]:
        """Singular values and components."""
        with one_thread():
            strongest = reduce(self.tree_.rows, min(self.n_components or self.size, self.n_features_in_))
            # Repeated in float64: components without variance are orthonormal as well.
            left, values, components = np.linalg.svd(strongest.astype(np.float64), full_matrices=False)
        return values, svd_flip(left, components, u_based_decision=False)[1]

    def _insert(self, rows: np.ndarray, begin: bool) -> None:
        if begin:
            limit = min(self.size, rows.shape[1])
            if self.n_components is not None and not 1 <= self.n_components <= limit:
                raise ValueError(
                    f"n_components={self.n_components} is not between 1 and min(size, features)={limit}: "
                    "choose fewer components, or a larger size"
                )
            self.tree_, self.n_samples_seen_, self.mean_ = CoresetTree(self.size), 0, rows[0].astype(np.float64)
        for part in gen_batches(len(rows), 8 * self.size):
            before = self.n_samples_seen_ + np.arange(len(rows[part]))[:, None]
            offsets = rows[part] - self.mean_
            sums = offsets.cumsum(axis=0)
            centred = offsets - (sums - offsets) / np.maximum(before, 1)
            self.tree_.insert(np.sqrt(before / (before + 1)) * centred)
            self.n_samples_seen_ += len(centred)
            self.mean_ = self.mean_ + sums[-1] / self.n_samples_seen_
        self.__dict__.pop("_decomposition", None)
