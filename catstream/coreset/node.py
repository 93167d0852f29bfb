"""A node of the coreset tree, which summarises consecutive rows, and the sample of several nodes.

The hierarchical sample has more rows of a node the higher its level is. The rows of a node are singular directions, not
images: the sign of each is arbitrary, and all except the first have a mean near zero, so that a classifier cannot be
trained on them. Any left rotation Q of a coreset is an equivalent coreset, ||Q C Y|| = ||C Y||. The reflection that
distributes the first row, the mean direction, evenly over all rows makes every row the mean plus a variation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile

import numpy as np

from catstream.coreset.reduce import energy, products, reduce

_EMPTY = np.empty((0, 0), np.float32)


@dataclass(frozen=True, eq=False)
class Node:
    """A coreset of `count` consecutive rows.

    level   0 for a leaf, otherwise one more than the level of the two nodes that were merged; it summarises
            n * 2**level rows
    rows    float32 (n, d): the original rows in a leaf, otherwise orthogonal rows, strongest direction first, and
            zeros after the first d
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
        """c of the paper, the energy that all reductions below it dropped: ||A||^2 = ||C||^2 + c up to rounding."""
        return max(self.energy - energy(self.rows), 0.0)  # rounding may make it negative

    @cached_property
    def products(self) -> np.ndarray:
        """The Gram matrix of its rows, float32 (n, n), as `catstream.coreset.reduce.products` returns it."""
        # Products of orthogonal rows are not computed: they are zero, up to rounding.
        return np.diag(np.einsum("ij,ij->i", self.rows, self.rows)) if self.level else products(self.rows)

    def products_with(self, newer: Node) -> np.ndarray | None:
        """The Gram matrix of its rows stacked on the rows of a newer node, float32 (2n, 2n).

        None if rows are shorter than 2n: `catstream.coreset.reduce.reduce` does not need it.
        """
        n, d = self.rows.shape
        if d < 2 * n:
            return None
        gram = np.zeros((2 * n, 2 * n), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # `reduce` then computes it in another unit
            gram[:n, :n] = self.products
            gram[n:, n:] = newer.products
            gram[n:, :n] = newer.rows @ self.rows.T
        return gram

    def directions(self, count: int) -> np.ndarray:
        """The `count` strongest of its rows after a rotation that makes them orthogonal, float32 (count, d)."""
        # Leaves are rotated only if they are sampled: most of them are merged before.
        return self.rows[:count] if self.level else reduce(self.rows, count, self.sum, self.products)

    def merged(self, newer: Node) -> Node:
        """The node one level up that summarises this node and a newer one of the same level."""
        total = self.sum + newer.sum
        rows = reduce(np.vstack([self.rows, newer.rows]), len(self.rows), total, self.products_with(newer))
        return Node(self.level + 1, rows, self.count + newer.count, total, self.energy + newer.energy)


def sample(
    nodes: Sequence[Node], size: int, last_nodes: Sequence[Node] = (), last_rows: np.ndarray = _EMPTY
) -> np.ndarray:
    """The first n w rows of every node, reflected and rescaled so that they have the weight of one original row.

    The nodes are oldest first, with strictly decreasing levels. Given the nodes and the rows of the last sample, the
    rows of the common first nodes are reused. Returns float32 (r, d), r <= 2n; (0, 0) without nodes.
    """
    if not nodes:
        return _EMPTY
    counts = [size >> (nodes[0].level - node.level) for node in nodes]  # n w with w = 2**(level - top), rounded down
    # The counts depend on the level of the oldest node: if it is unchanged, so are the rows of all unchanged nodes.
    same = sum(1 for _ in takewhile(lambda pair: pair[0] is pair[1], zip(nodes, last_nodes, strict=False)))
    reused = last_rows[: sum(counts[:same])]
    if same == len(nodes):
        return reused
    parts = [reused] if same else []
    for node, count in zip(nodes[same:], counts[same:], strict=True):
        if count:
            rows = node.directions(count) * np.float32(np.sqrt(count / node.count))
            spread(rows)
            parts.append(rows)
    return np.concatenate(parts)


def spread(rows: np.ndarray) -> None:
    """Reflect rows, in place, so that the first is distributed evenly over all: Q C with Q e1 = 1 / sqrt(m).

    A Householder reflection: Q'Q = I, so that the result is the same coreset. Costs O(m d).

    >>> rows = np.array([[2, 0], [0, 1], [0, 0], [0, 0]], np.float32)
    >>> spread(rows)
    >>> rows[:, 0]
    array([1., 1., 1., 1.], dtype=float32)
    """
    m = len(rows)
    if m < 2:
        return
    normal = np.full(m, -1 / np.sqrt(m), np.float32)
    normal[0] += 1
    normal /= np.linalg.norm(normal)
    rows -= np.outer(2 * normal, normal @ rows)
