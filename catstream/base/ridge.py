"""Ridge regression in closed form, for far fewer rows than features.

By the push-through identity an r x r system is solved in place of a d x d one: O(r^2 d) for r rows of length d.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np


def prepare() -> None:
    """Import scipy.linalg in advance, which takes 0.2 s; clients of a pipeline do not need it."""
    import scipy.linalg  # noqa: F401


def discriminant(background: np.ndarray, difference: np.ndarray, penalty: float) -> np.ndarray:
    """The regularised linear discriminant of two classes: w = (S + penalty I)^-1 difference, float32 (d,).

    S is the covariance of the background, float32 (r, d); `difference` is the mean of the object minus the mean of the
    background.
    """
    centred = background - background.mean(axis=0)
    solve = _solver(centred @ centred.T, penalty * len(centred))
    direction: np.ndarray = (difference - centred.T @ solve(centred @ difference)) / np.float32(penalty)
    return direction


class Regression:
    """The weights and the bias that minimise ||A [w; b] - y||^2 / r + penalty ||w||^2, for several labels y.

    The Gram matrix of the rows A is computed once, and factored once for each penalty; each further fit costs O(r d).
    The rows are float32 (r, d + 1): [x, 1], or any left rotation of them and the labels.
    """

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows
        self._gram = rows[:, :-1] @ rows[:, :-1].T
        self._solvers: dict[float, Callable[[np.ndarray], np.ndarray]] = {}

    def fit(self, labels: np.ndarray, penalty: float) -> tuple[np.ndarray, float]:
        """w, float32 (d,), and b, for labels float32 (r,)."""
        if penalty not in self._solvers:
            self._solvers[penalty] = _solver(self._gram.copy(), penalty * len(self.rows))
        x, ones = self.rows[:, :-1], self.rows[:, -1]
        solved = self._solvers[penalty](np.stack([labels, ones], axis=1))
        bias = (ones @ solved[:, 0]) / (ones @ solved[:, 1])
        weights: np.ndarray = x.T @ (solved[:, 0] - bias * solved[:, 1])
        return weights, float(bias)


def _solver(gram: np.ndarray, penalty: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that solves (gram + penalty I) z = y by the Cholesky factor; overwrites `gram`."""
    import scipy.linalg

    gram[np.diag_indices_from(gram)] += np.float32(penalty)
    factor = scipy.linalg.cho_factor(gram, overwrite_a=True, check_finite=False)
    return partial(scipy.linalg.cho_solve, factor, check_finite=False)  # can be pickled, unlike a closure
