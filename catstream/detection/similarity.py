"""Similarity: how much of a window's appearance lies in the subspace of the object's earlier appearances.

The score of a model separates the object from the background that it was trained on. In another scene, unrelated
windows may score high. A coreset preserves distances to subspaces, so they can be measured from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

#: Minimum similarity of the first detection of a saved model's object: 87 % of such windows pass, 1 % of others.
MIN_SIMILARITY = 0.5

_DIRECTIONS = 12  # dimension of the subspace


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """The subspace of an object, with the share of the energy of its own rows that lies in the subspace.

    With the mean b of the background, the share of a row x is ||V (x - b)||^2 / ||x - b||^2. Its similarity is this
    share divided by the share of the object's own rows, so that one threshold holds for all objects.

    basis       V, float32 (k, d), orthonormal rows
    background  b, float32 (d,)
    share       of the energy of all rows of the object: sum of ||V (a - b)||^2 / sum of ||a - b||^2
    """

    basis: np.ndarray
    background: np.ndarray
    share: float

    @classmethod
    def of(cls, rows: np.ndarray, energy: float, total: np.ndarray, count: int, background: np.ndarray) -> Self:
        """Compute the subspace of rows A from their coreset. Costs one QR decomposition, O(r^2 d).

        Parameters
        ----------
        rows : float32 (r, d), the coreset C
        energy : ||A||^2
        total : float64 (d,), sum of the rows of A
        count : number of rows of A
        background : float32 (d,), mean of the background, which is subtracted
        """
        # The sum of (a - b)(a - b)' over all rows a is A'A - s b' - b s' + count b b', in the span of C, s and b.
        span = np.linalg.qr(np.vstack([rows, total / count, background]).T.astype(np.float64))[0]
        inner, s, b = span.T @ rows.T, span.T @ total, span.T @ background
        moment = inner @ inner.T - np.outer(s, b) - np.outer(b, s) + count * np.outer(b, b)
        values, vectors = np.linalg.eigh(moment)
        whole = energy - 2 * float(s @ b) + count * float(b @ b)
        basis = (span @ vectors[:, : -_DIRECTIONS - 1 : -1]).T.astype(np.float32)
        return cls(basis, background, float(values[-_DIRECTIONS:].sum()) / whole)

    def __call__(self, row: np.ndarray) -> float:
        """Similarity of a row, float32 (d,): about 1 for the object, about 0.2 for an unknown background."""
        away = row - self.background
        inside = self.basis @ away
        return float(inside @ inside) / (self.share * float(away @ away) + 1e-12)
