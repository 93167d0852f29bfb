"""The paper's classifier: a one-class linear support vector machine (paper, "Training").

It finds the direction in which all but a share of the object's rows lie farthest
from the origin. HOG rows are never negative, so that around the true origin it
would only learn "has edges": the origin is put at the mean of the background.
"""

from __future__ import annotations

import numpy as np
from sklearn.svm import OneClassSVM

from catstream.errors import ProtocolError


def one_class(rows: np.ndarray, origin: np.ndarray, nu: float = 0.5) -> np.ndarray:
    """Find the direction that holds the rows farthest from an origin.

    At least `1 - nu` of the rows lie beyond the hyperplane across it. The same rows
    give the same bits. Costs the Gram matrix, O(r^2 d), of which only a solver of
    r unknowns sees more; several times faster than solving in d dimensions.

    Parameters
    ----------
    rows : float32 (r, d), a sample of the object's coreset tree: spread, each weighing one
    origin : float32 (d,), mean of the background
    nu : share of rows that may be outliers, above 0 and below 1

    Returns
    -------
    float32 (d,), of any length: scaling the score is left to the caller

    Raises
    ------
    ProtocolError
        Where there are no rows, or none differs from the origin.

    >>> direction = one_class(np.array([[3, 1], [3, 2], [3, 0]], np.float32), np.array([1, 1], np.float32))
    >>> (direction / direction[0]).round(3)
    array([1., 0.], dtype=float32)
    """
    centred = rows - origin
    gram = centred @ centred.T
    if not gram.any():
        raise ProtocolError(
            f"none of the {len(rows)} rows of the object differs from the background: choose another box"
        )
    machine = OneClassSVM(kernel="precomputed", nu=nu).fit(gram)
    normal: np.ndarray = machine.dual_coef_[0].astype(np.float32) @ centred[machine.support_]
    return normal
