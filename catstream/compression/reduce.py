"""Reduction of many rows to few, by the singular value decomposition A = U S V'.

The first n rows of S V' are optimal: no other n rows keep more of ||A||^2, the sum of squares.
"""

from __future__ import annotations

import numpy as np

from catstream.arrays import Float32

__all__ = ["energy", "prepare", "reduce"]


def prepare() -> None:
    """Import scipy before the first reduction, which would otherwise take a quarter of a second longer."""
    import scipy.linalg  # noqa: F401


def energy(rows: np.ndarray) -> float:
    """||A||^2, the sum of the squares of all elements, summed in float64.

    >>> energy(np.ones((2, 3), np.float32))
    6.0
    """
    flat = rows.ravel().astype(np.float64)
    return float(flat @ flat)


def reduce(rows: np.ndarray, size: int, towards: np.ndarray | None = None) -> np.ndarray:
    """Shrink rows to at most `size`, keeping the strongest directions.

    For every orthonormal Y, ||A Y||^2 - c <= ||C Y||^2 <= ||A Y||^2 with
    c = ||A||^2 - ||C||^2 (paper, "Coresets"). Costs one Gram matrix and its
    eigenvectors, O(m^2 d) for m rows of length d > m.

    Parameters
    ----------
    rows : float32 (m, d)
    size : rows to keep (n in the paper), at least 1
    towards : float (d,), each row gets the sign with which its product with this vector is not negative, because the
        sign of a singular vector is arbitrary; None: the sum of the rows

    Returns
    -------
    float32 (min(size, m), d), strongest first, orthogonal to one another

    >>> reduce(np.ones((6, 4), np.float32), size=2).shape
    (2, 4)
    """
    import scipy.linalg  # imported late, so that a restarted compressor can answer first

    m = len(rows)
    keep = min(size, m)
    gram = rows @ rows.T
    # Divide and conquer: the default driver loses orthogonality, or vectors, if many eigenvalues are equal.
    _, vectors = scipy.linalg.eigh(gram, driver="evd", overwrite_a=True, check_finite=False)
    kept: Float32 = vectors[:, : -keep - 1 : -1].T @ rows
    kept[kept @ (rows.sum(axis=0) if towards is None else towards).astype(np.float32) < 0] *= -1
    return kept
