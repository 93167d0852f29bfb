"""Linear models in closed form, from coresets alone.

Both solve a ridge regression whose data matrix is a sample of a coreset tree. By
the push-through identity only a `rows x rows` system is solved, never a `d x d`
one: O(r^2 d) for r rows.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

__all__ = ["of_loss", "of_means"]


def of_means(background: np.ndarray, mean_background: np.ndarray, mean_object: np.ndarray, ridge: float) -> np.ndarray:
    """The direction that tells the object's mean from the background, w = (S + ridge I)^-1 (mean_object - mean_background).

    S = B'B / r - mean mean' is the covariance of the background: least squares of two classes.

    Parameters
    ----------
    background : float32 (r, d), rows of the background tree, each weighing one
    mean_background, mean_object : float32 (d,), exact means
    ridge : lambda, in units of a row's variance a feature

    Returns
    -------
    float32 (d,)
    """
    centred = (background - background.mean(axis=0)) / np.float32(np.sqrt(len(background)))
    towards = mean_object - mean_background
    system = centred @ centred.T
    system[np.diag_indices_from(system)] += np.float32(ridge)
    inner = scipy.linalg.solve(system, centred @ towards, assume_a="pos", overwrite_a=True, check_finite=False)
    return (towards - centred.T @ inner) / np.float32(ridge)


def of_loss(rows: np.ndarray, ridge: float) -> np.ndarray:
    """The weights that minimise ||A [w; b; -1]||^2 / r + ridge ||w||^2, with a free bias b.

    Parameters
    ----------
    rows : float32 (r, d + 2), rows [x, 1, y] of the loss tree, in any left rotation
    ridge : lambda

    Returns
    -------
    float32 (d,), w; the bias is left to whoever scales the score
    """
    scale = np.float32(1 / np.sqrt(len(rows)))
    x, ones, y = rows[:, :-2] * scale, rows[:, -2] * scale, rows[:, -1] * scale
    system = x @ x.T
    system[np.diag_indices_from(system)] += np.float32(ridge)
    solved = scipy.linalg.solve(system, np.stack([y, ones], 1), assume_a="pos", overwrite_a=True, check_finite=False)
    bias = (ones @ solved[:, 0]) / (ones @ solved[:, 1])
    return x.T @ (solved[:, 0] - bias * solved[:, 1])
