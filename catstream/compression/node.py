"""A node of the coreset tree: what consecutive rows are summarised by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from catstream.compression.reduce import energy, reduce

__all__ = ["Node"]


@dataclass(frozen=True, eq=False)
class Node:
    """A coreset of `count` consecutive rows.

    level   how often it was merged: 0 for a leaf; it stands for n * 2**level rows
    rows    float32 (n, d): of a leaf as they came, else orthogonal, strongest direction first
    count   rows it stands for
    sum     float64 (d,), their exact sum
    energy  ||A||^2 of all of them
    """

    level: int
    rows: np.ndarray
    count: int
    sum: np.ndarray
    energy: float

    @classmethod
    def leaf(cls, rows: np.ndarray) -> Node:
        """A node of level 0: the rows themselves."""
        return cls(0, rows, len(rows), rows.sum(axis=0, dtype=np.float64), energy(rows))

    @property
    def dropped(self) -> float:
        """c of the paper: what all reductions below it lost, ||A||^2 = ||C||^2 + c."""
        return self.energy - energy(self.rows)

    @cached_property
    def directions(self) -> np.ndarray:
        """Its rows turned so that they are orthogonal, and the strongest comes first."""
        # Most leaves are merged before anyone asks, which saves turning them.
        return self.rows if self.level else reduce(self.rows, len(self.rows), towards=self.sum)

    def merged(self, newer: Node) -> Node:
        """One node, a level up, for the rows of two of the same level."""
        total = self.sum + newer.sum
        rows = reduce(np.vstack([self.rows, newer.rows]), len(self.rows), towards=total)
        return Node(self.level + 1, rows, self.count + newer.count, total, self.energy + newer.energy)
