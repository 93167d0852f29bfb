"""Ridge regression in closed form, for far fewer rows than features.

By the push-through identity only a `rows x rows` system is solved, never a
`d x d` one: O(r^2 d) for r rows.
"""

from __future__ import annotations

import numpy as np

__all__ = ["between", "fit", "prepare"]


def prepare() -> None:
    """Import what the first call needs, in a quarter of a second: for who has the time before it."""
    import scipy.linalg  # noqa: F401


def between(background: np.ndarray, towards: np.ndarray, penalty: float) -> np.ndarray:
    """The direction that tells two means apart over a background: w = (S + penalty I)^-1 towards.

    S is the covariance of the background: least squares of two classes.

    Parameters
    ----------
    background : float32 (r, d)
    towards : float32 (d,), the object's mean minus the background's
    penalty : lambda, in units of a feature's variance

    Returns
    -------
    float32 (d,)
    """
    centred = (background - background.mean(axis=0)) / np.float32(np.sqrt(len(background)))
    inner = _solve(centred @ centred.T, penalty, centred @ towards)
    direction: np.ndarray = (towards - centred.T @ inner) / np.float32(penalty)
    return direction


def fit(rows: np.ndarray, penalty: float) -> np.ndarray:
    """The weights that minimise ||A [w; b; -1]||^2 / r + penalty ||w||^2, with a free bias b.

    Parameters
    ----------
    rows : float32 (r, d + 2), A: rows [x, 1, y], or any left rotation of them
    penalty : lambda

    Returns
    -------
    float32 (d,), w; the bias is left to whoever scales the score
    """
    scaled = rows / np.float32(np.sqrt(len(rows)))
    x, ones, y = scaled[:, :-2], scaled[:, -2], scaled[:, -1]
    solved = _solve(x @ x.T, penalty, np.stack([y, ones], axis=1))
    bias = (ones @ solved[:, 0]) / (ones @ solved[:, 1])
    weights: np.ndarray = x.T @ (solved[:, 0] - bias * solved[:, 1])
    return weights


def _solve(gram: np.ndarray, penalty: float, right: np.ndarray) -> np.ndarray:
    import scipy.linalg  # a restarted detector has its model, and needs none of it

    gram[np.diag_indices_from(gram)] += np.float32(penalty)
    solved: np.ndarray = scipy.linalg.solve(gram, right, assume_a="pos", overwrite_a=True, check_finite=False)
    return solved
