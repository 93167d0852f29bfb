"""A node of the coreset tree: the summary of consecutive rows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from catstream.compression.reduce import energy, products, reduce


@dataclass(frozen=True, eq=False)
class Node:
    """A coreset of `count` consecutive rows.

    level   0 for a leaf, otherwise one more than the level of the two nodes that were merged; it summarises
            n * 2**level rows
    rows    float32 (n, d): the original rows in a leaf, otherwise orthogonal rows, strongest direction first
    count   number of rows that it summarises
    sum     float64 (d,), exact sum of these rows
    energy  ||A||^2 of these rows
    """

    level: int
    rows: np.ndarray
    count: int
    sum: np.ndarray
    energy: float

    @classmethod
    def leaf(cls, rows: np.ndarray) -> Node:
        """A node of level 0: the rows themselves."""
        wide = rows.astype(np.float64)
        return cls(0, rows, len(rows), wide.sum(axis=0), energy(wide))

    @property
    def dropped(self) -> float:
        """c of the paper, the energy that all reductions below it lost: ||A||^2 = ||C||^2 + c."""
        return self.energy - energy(self.rows)

    @cached_property
    def products(self) -> np.ndarray:
        """The products of all pairs of its rows, float32 (n, n), as those of `catstream.compression.reduce`."""
        # Those of orthogonal rows are not computed: they are zero, up to rounding.
        return np.diag(np.einsum("ij,ij->i", self.rows, self.rows)) if self.level else products(self.rows)

    def products_with(self, newer: Node) -> np.ndarray:
        """The products of all pairs of its rows above those of a newer node, float32 (2n, 2n)."""
        n = len(self.rows)
        gram = np.zeros((2 * n, 2 * n), np.float32)
        gram[:n, :n], gram[n:, n:], gram[n:, :n] = self.products, newer.products, newer.rows @ self.rows.T
        return gram

    def directions(self, count: int) -> np.ndarray:
        """Its rows rotated so that they are orthogonal, strongest first: so many of them, float32 (count, d)."""
        # Leaves are rotated only if a sample is made of them: most are merged before.
        return self.rows[:count] if self.level else reduce(self.rows, count, self.sum, self.products)

    def merged(self, newer: Node) -> Node:
        """The node one level up that summarises this node and a newer one of the same level."""
        total = self.sum + newer.sum
        rows = reduce(np.vstack([self.rows, newer.rows]), len(self.rows), total, self.products_with(newer))
        return Node(self.level + 1, rows, self.count + newer.count, total, self.energy + newer.energy)
