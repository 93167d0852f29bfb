"""Ridge regression in closed form, for far fewer rows than features.

By the push-through identity an r x r system is solved in place of a d x d one: O(r^2 d) for r rows of length d.
"""

from __future__ import annotations

import numpy as np

__all__ = ["between", "fit", "prepare"]


def prepare() -> None:
    """Import scipy before the first call, which would otherwise take a quarter of a second longer."""
    import scipy.linalg  # noqa: F401


def between(background: np.ndarray, towards: np.ndarray, penalty: float) -> np.ndarray:
    """The least-squares direction between two classes: w = (S + penalty I)^-1 towards.

    S is the covariance of the background.

    Parameters
    ----------
    background : float32 (r, d)
    towards : float32 (d,), mean of the object minus mean of the background
    penalty : lambda, in units of a feature's variance

    Returns
    -------
    float32 (d,)
    """
    centred = (background - background.mean(axis=0)) / np.float32(np.sqrt(len(background)))
    inner = _solve(centred @ centred.T, penalty, centred @ towards)
    direction: np.ndarray = (towards - centred.T @ inner) / np.float32(penalty)
    return direction


def fit(rows: np.ndarray, penalty: float) -> tuple[np.ndarray, float]:
    """The weights and the bias that minimise ||A [w; b; -1]||^2 / r + penalty ||w||^2.

    Parameters
    ----------
    rows : float32 (r, d + 2), A: rows [x, 1, y], or any left rotation of them
    penalty : lambda

    Returns
    -------
    w, float32 (d,), and b
    """
    scaled = rows / np.float32(np.sqrt(len(rows)))
    x, ones, y = scaled[:, :-2], scaled[:, -2], scaled[:, -1]
    solved = _solve(x @ x.T, penalty, np.stack([y, ones], axis=1))
    bias = (ones @ solved[:, 0]) / (ones @ solved[:, 1])
    weights: np.ndarray = x.T @ (solved[:, 0] - bias * solved[:, 1])
    return weights, float(bias)


def _solve(gram: np.ndarray, penalty: float, right: np.ndarray) -> np.ndarray:
    import scipy.linalg  # imported late: a restarted detector has its model, and does not need scipy

    gram[np.diag_indices_from(gram)] += np.float32(penalty)
    solved: np.ndarray = scipy.linalg.solve(gram, right, assume_a="pos", overwrite_a=True, check_finite=False)
    return solved
