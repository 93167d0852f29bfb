"""A node of the coreset tree: what consecutive rows are summarised by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from catstream.compression.reduce import energy, reduce

__all__ = ["Node"]


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """A coreset of `count` consecutive rows.

    level    how often it was merged: 0 for a leaf; it stands for n * 2**level rows
    rows     float32 (n, d), strongest direction first, orthogonal
    count    rows it stands for
    sum      float64 (d,), their exact sum
    dropped  c of the paper: energy lost in all reductions below it, ||A||^2 = ||C||^2 + c
    """

    level: int
    rows: np.ndarray
    count: int
    sum: np.ndarray
    dropped: float

    @classmethod
    def leaf(cls, rows: np.ndarray) -> Node:
        """A node of level 0: the rows themselves, turned so that the strongest direction comes first."""
        total = rows.sum(axis=0, dtype=np.float64)
        turned = reduce(rows, len(rows), towards=total)
        return cls(0, turned, len(rows), total, energy(rows) - energy(turned))

    def merged(self, newer: Node) -> Node:
        """One node, a level up, for the rows of two of the same level."""
        both = np.vstack([self.rows, newer.rows])
        total = self.sum + newer.sum
        rows = reduce(both, len(self.rows), towards=total)
        dropped = self.dropped + newer.dropped + energy(both) - energy(rows)
        return Node(self.level + 1, rows, self.count + newer.count, total, dropped)
