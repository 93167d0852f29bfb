"""Array types by dtype (the docstrings state the shapes), and a fast check for finite values."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Bool = npt.NDArray[np.bool_]
UInt8 = npt.NDArray[np.uint8]
UInt16 = npt.NDArray[np.uint16]
UInt32 = npt.NDArray[np.uint32]
Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


def is_finite(array: np.ndarray) -> bool:
    """Return True if all numbers are finite, in one pass without a temporary array.

    >>> is_finite(np.array([1.0, 1e200])), is_finite(np.array([1.0, np.nan]))
    (True, False)
    """
    # A finite sum of squares implies finite numbers. An infinite one may be an overflow: check each number.
    return math.isfinite(np.vdot(array, array)) or bool(np.isfinite(array).all())
