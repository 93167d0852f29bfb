"""The hierarchical sample: more rows of a node the higher its level is.

The rows of a node are singular directions, not images: the sign of each is arbitrary, and all except the first have a
mean near zero, so that a classifier cannot be trained on them. Any left rotation Q of a coreset is an equivalent
coreset, ||Q C Y|| = ||C Y||. The reflection that distributes the first row, the mean direction, evenly over all rows
makes every row the mean plus a variation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from catstream.compression.node import Node

__all__ = ["sample", "share", "spread"]


def share(level: int, top: int, size: int) -> int:
    """Number of rows to take from a node: n w with w = 2**(level - top), rounded down.

    >>> [share(level, top=3, size=64) for level in (3, 2, 0)]
    [64, 32, 8]
    """
    return size >> (top - level)


def sample(nodes: Sequence[Node], size: int) -> np.ndarray:
    """The first n w rows of each node, reflected and rescaled so that each has the weight of one original row.

    Parameters
    ----------
    nodes : oldest first, levels strictly falling
    size : n

    Returns
    -------
    float32 (r, d), r <= 2n; (0, 0) for no nodes
    """
    if not nodes:
        return np.empty((0, 0), np.float32)
    counts = [share(node.level, nodes[0].level, size) for node in nodes]
    rows = np.empty((sum(counts), nodes[0].rows.shape[1]), np.float32)
    for node, part in zip(nodes, np.split(rows, np.cumsum(counts[:-1])), strict=True):
        if count := len(part):
            np.multiply(node.directions[:count], np.float32(np.sqrt(count / node.count)), out=part)
            spread(part)
    return rows


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
