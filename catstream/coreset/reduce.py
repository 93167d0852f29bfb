"""Reduction of many rows to few, by the singular value decomposition A = U S V'.

The first n rows of S V' are optimal: no other n rows retain more of ||A||^2, the sum of squares.
"""

from __future__ import annotations

import numpy as np

from catstream.base.arrays import Float32, Float64

_SQUARES = 1e-30, 1e30  # range of the largest square in which float32 neither underflows nor overflows


def energy(rows: np.ndarray) -> float:
    """||A||^2, the sum of the squares of all elements, summed in float64.

    >>> energy(np.ones((2, 3), np.float32))
    6.0
    """
    flat = rows.ravel().astype(np.float64, copy=False)
    return float(flat @ flat)


def products(rows: np.ndarray) -> np.ndarray:
    """The lower triangle of the Gram matrix of rows, float32 (m, m).

    >>> products(np.array([[2, 0], [3, 1]], np.float32))
    array([[ 4.,  0.],
           [ 6., 10.]], dtype=float32)
    """
    from scipy.linalg.blas import ssyrk

    gram: np.ndarray = ssyrk(1, rows.T, trans=1, lower=1)  # one triangle: the matrix is symmetric
    return gram


def reduce(
    rows: np.ndarray, size: int, towards: np.ndarray | None = None, gram: np.ndarray | None = None
) -> np.ndarray:
    """Reduce rows to at most `size`, along the strongest singular vectors.

    For every orthonormal Y, ||A Y||^2 - c <= ||C Y||^2 <= ||A Y||^2, up to rounding, with c = ||A||^2 - ||C||^2 (paper,
    "Coresets"). Costs one triangle of a matrix of products and its eigenvectors: of A A' for m rows of length d >= m,
    O(m^2 d); of A'A for shorter rows, O(m d^2).

    Parameters
    ----------
    rows : float32 (m, d)
    size : number of rows of the result (n in the paper), at least 1
    towards : float (d,), a vector whose products with the rows of the result are not negative, because the sign of a
        singular vector is arbitrary; None: the sum of the rows
    gram : `products` of the rows, if already computed

    Returns
    -------
    float32 (min(size, m), d), strongest first, orthogonal to one another; zeros after the first d

    >>> reduce(np.ones((6, 4), np.float32), size=2).shape
    (2, 4)
    """
    _, strongest = _strongest(rows, size, towards, gram)
    return strongest


def shrink(
    rows: np.ndarray, size: int, towards: np.ndarray | None = None, gram: np.ndarray | None = None
) -> np.ndarray:
    """Shrink rows to `size` by frequent directions (Liberty 2013): all lose the energy of the strongest dropped row.

    With s_i the singular values, strongest first, row i has the energy max(s_i^2 - s_(size + 1)^2, 0). For every unit
    vector y, 0 <= ||A y||^2 - ||C y||^2 <= s_(size + 1)^2 <= (||A||^2 - ||C||^2) / (size + 1). Costs the same as
    `reduce`, whose parameters it has; there are more than `size` rows.

    Returns
    -------
    float32 (size, d), strongest first, orthogonal to one another

    >>> (shrink(np.diag([3.0, 2, 1]).astype(np.float32), size=2) ** 2).round().tolist()
    [[8.0, 0.0, 0.0], [0.0, 3.0, 0.0]]
    """
    energies, strongest = _strongest(rows, size + 1, towards, gram)
    scale = np.sqrt(1 - energies[size] / np.where(energies[:size] > 0, energies[:size], 1))
    shrunk: Float32 = (strongest[:size] * scale[:, None]).astype(np.float32)
    return shrunk


def _strongest(
    rows: np.ndarray, count: int, towards: np.ndarray | None, gram: np.ndarray | None
) -> tuple[np.ndarray, Float32]:
    """Energies, in any unit, and rows s_i v_i of the `count` strongest singular vectors, or all if there are fewer."""
    count = min(count, len(rows))
    target = (rows.sum(axis=0) if towards is None else towards).astype(np.float32)
    if rows.shape[1] < len(rows):
        return _strongest_of_short_rows(rows, count, target)
    from scipy.linalg.lapack import ssyevd

    gram = products(rows) if gram is None else gram
    if not _SQUARES[0] < gram.diagonal().max() < _SQUARES[1] and (peak := np.abs(rows).max()) > 0:
        # Scaling by a power of two is exact. The energies stay scaled, because they are only compared.
        exponent = np.frexp(peak)[1]
        energies, strongest = _strongest(np.ldexp(rows, -exponent), count, np.ldexp(target, -exponent), None)
        return energies, np.ldexp(strongest, exponent)
    # Divide and conquer: other drivers lose orthogonality, or vectors, if many eigenvalues are equal.
    energies, vectors, failed = ssyevd(gram, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"the eigenvectors of the Gram matrix of {len(rows)} rows did not converge")
    # The sum of the rows of A, weighted by row i of `strongest`, is s_i v_i.
    strongest = vectors.T[: -count - 1 : -1].copy()
    with np.errstate(invalid="ignore"):  # OpenBLAS may set the flag for memory beyond the rows
        strongest[strongest @ (rows @ target) < 0] *= -1
    return energies[: -count - 1 : -1].clip(min=0), strongest @ rows


def _strongest_of_short_rows(rows: Float32, count: int, target: Float32) -> tuple[Float64, Float32]:
    """The result of `_strongest` from A'A, d x d, in float64; zeros follow the d strongest."""
    from scipy.linalg.blas import dsyrk
    from scipy.linalg.lapack import dsyevd

    values, vectors, failed = dsyevd(dsyrk(1, rows.T.astype(np.float64), lower=1), lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"the eigenvectors of A'A of {len(rows)} rows did not converge")
    energies: Float64 = np.zeros(count)
    strongest: Float64 = np.zeros((count, rows.shape[1]))
    energies[: len(values)] = values[: -count - 1 : -1].clip(min=0)
    strongest[: len(values)] = vectors.T[: -count - 1 : -1]
    strongest[strongest @ target < 0] *= -1
    return energies, (np.sqrt(energies)[:, None] * strongest).astype(np.float32)
