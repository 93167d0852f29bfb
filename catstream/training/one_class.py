"""The paper's classifier: a one-class linear support vector machine (paper, "Training").

It separates all but a share of the object's rows from the origin by the hyperplane with the largest margin. HOG rows
are never negative, so with the true origin it would only learn "has edges". The origin is the mean of the background.
"""

from __future__ import annotations

import numpy as np
from sklearn.svm import OneClassSVM

from catstream.errors import ProtocolError


def one_class(rows: np.ndarray, origin: np.ndarray, nu: float = 0.5) -> np.ndarray:
    """Return the normal of the hyperplane that separates rows from an origin with the largest margin.

    At least `1 - nu` of the rows lie beyond the hyperplane. The same rows give the same bits. Costs the Gram matrix,
    O(r^2 d), and a solver of r unknowns: several times faster than solving in d dimensions.

    Parameters
    ----------
    rows : float32 (r, d), a sample of the object's coreset tree, in which all rows have the weight 1
    origin : float32 (d,), mean of the background
    nu : share of rows that may be outliers, above 0 and below 1

    Returns
    -------
    float32 (d,), not normalised; ProtocolError if no row differs from the origin

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
