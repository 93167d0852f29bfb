"""The coreset tree: a summary of all inserted rows in logarithmic memory.

Every n rows become a leaf. Whenever the two newest nodes have the same level, their 2n rows are reduced to n, and
become a node one level up (paper, "Coreset Tree Implementation"). `FrequentDirections` keeps a single node instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import Self

import numpy as np

from catstream.base.arrays import Float32, Float64, is_finite
from catstream.base.threads import one_thread
from catstream.coreset.node import Node, sample
from catstream.coreset.reduce import energy, shrink
from catstream.errors import ProtocolError
from catstream.wire import storage
from catstream.wire.messages import Summary
from catstream.wire.storage import Arrays, Metadata

_LEVELS = 64  # no stream has 2**64 leaves


class CoresetTree:
    """A coreset of a stream of rows, by merge and reduce.

    For p rows it stores at most log2(p / n) + 1 nodes, O(n d log p) bytes. Inserting a row costs O(n d) on average,
    whatever p is. For every orthonormal Y, `||A Y||^2 - c <= ||C Y||^2 <= ||A Y||^2`, up to the rounding of float32,
    where A are all inserted rows, C is `rows`, and c is `dropped_energy`. If d <= n, C'C is A'A: nothing is dropped.
    While rows are reduced, linear algebra runs on one thread in the whole process: more threads are slower.

    >>> tree = CoresetTree(size=4)
    >>> tree.insert(np.eye(13, 5, dtype=np.float32))
    >>> [node.level for node in tree.nodes], len(tree.pending), tree.rows_seen
    ([1, 0], 1, 13)

    Parameters
    ----------
    size : number of rows of a node, n in the paper
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"a coreset needs at least 1 row, got size={size}")
        self.size = size
        self.nodes: list[Node] = []
        self._leaf = np.empty((0, 0), np.float32)  # memory for the next leaf
        self._filled = 0  # number of rows in it
        self._sampled: list[Node] = []  # nodes of the last sample
        self._rows = np.empty((0, 0), np.float32)  # rows of the last sample

    @property
    def pending(self) -> np.ndarray:
        """The newest rows, fewer than a leaf has, float32 (k, d); later rows do not change them."""
        return self._leaf[: self._filled]

    @property
    def rows(self) -> np.ndarray:
        """The summary: rows of all nodes, oldest first, and the pending rows, C of the paper, float32 (m, d)."""
        rows: Float32 = np.vstack([*(node.rows for node in self.nodes), self.pending])
        return rows

    @property
    def width(self) -> int:
        """Length d of a row, 0 before the first."""
        return self.nodes[0].rows.shape[1] if self.nodes else self._leaf.shape[1]

    @property
    def rows_seen(self) -> int:
        """Number of inserted rows, p in the paper."""
        return sum(node.count for node in self.nodes) + len(self.pending)

    @property
    def leaves(self) -> int:
        """Number of leaves that were inserted: complete groups of `size` rows."""
        return sum(node.count for node in self.nodes) // self.size

    @property
    def sum(self) -> np.ndarray:
        """Exact sum of all inserted rows, float64 (d,)."""
        total: Float64 = self.pending.sum(axis=0, dtype=np.float64)
        for node in self.nodes:
            total = total + node.sum
        return total

    @property
    def energy(self) -> float:
        """||A||^2, the sum of the squares of all inserted rows, in float64."""
        return sum(node.energy for node in self.nodes) + energy(self.pending)

    @property
    def dropped_energy(self) -> float:
        """c of the paper: the part of `energy` that the reductions have dropped, never negative."""
        return sum(node.dropped for node in self.nodes)

    @property
    def nbytes(self) -> int:
        """Size of the rows and of their sums in bytes."""
        return self.pending.nbytes + sum(node.rows.nbytes + node.sum.nbytes for node in self.nodes)

    def insert(self, rows: np.ndarray) -> None:
        """Add rows, float32 (k, d), in the order of the stream.

        ProtocolError, a ValueError, if their length differs from earlier rows, or if a number is not finite.
        """
        self.extend(self._checked(rows))

    def extend(self, rows: np.ndarray) -> None:
        """Add rows as `insert` does, without its checks: the rows of a message were checked at reception."""
        # Limit the threads once for all leaves, and only if a leaf is completed: a limit costs as much as some rows.
        with one_thread() if self._filled + len(rows) >= self.size else nullcontext():
            while len(rows):
                count = min(len(rows), self.size - self._filled)
                self._append(rows[:count])
                rows = rows[count:]
                if self._filled == self.size:
                    self._filled = 0
                    self._push(Node.leaf(self._leaf))

    def copy(self) -> Self:
        """An independent tree with the same content."""
        tree = type(self)(self.size)
        tree.nodes = list(self.nodes)  # nodes and pending rows never change
        tree._leaf, tree._filled = self.pending, self._filled
        return tree

    @one_thread()
    def merged(self, other: CoresetTree) -> Self:
        """A new tree of both streams; the bound holds as if all rows had been inserted into one tree."""
        if type(other) is not type(self):
            raise ProtocolError(
                f"a {type(self).__name__} cannot merge a {type(other).__name__}: build both as {type(self).__name__}"
            )
        if other.size != self.size:
            raise ProtocolError(
                f"a tree of size {self.size} cannot merge one of size {other.size}: build both with the same size"
            )
        if self.width and other.width and self.width != other.width:
            raise ProtocolError(
                f"a tree of rows of length {self.width} cannot merge rows of length {other.width}: "
                "merge trees of rows of the same length"
            )
        tree = self.copy()
        if not tree.width:
            tree._leaf = np.empty((0, other.width), np.float32)
        tree.nodes = []
        for node in sorted([*self.nodes, *other.nodes], key=lambda node: -node.level):
            tree._push(node)
        if len(other.pending):
            tree.insert(other.pending)
        return tree

    @one_thread()
    def sample(self) -> Summary:
        """A hierarchical sample of at most 2n rows (paper, "Coreset Appearance Model").

        The rows of nodes that the last sample contained are reused: most nodes are the same for many frames.
        """
        self._rows = sample(self.nodes, self.size, self._sampled, self._rows)
        self._sampled = list(self.nodes)
        return Summary(
            rows=self._rows,
            mean=(self.sum / max(self.rows_seen, 1)).astype(np.float32),
            count=self.rows_seen,
            levels=tuple(node.level for node in self.nodes),
        )

    def state(self) -> tuple[Arrays, Metadata]:
        """Arrays and metadata that `from_state` restores."""
        arrays = {"pending": self.pending}
        for i, node in enumerate(self.nodes):
            arrays[f"rows.{i}"] = node.rows
            arrays[f"sum.{i}"] = node.sum
        nodes = [{"level": node.level, "count": node.count, "energy": node.energy.hex()} for node in self.nodes]
        return arrays, {"size": self.size, "nodes": nodes}

    @classmethod
    def from_state(cls, arrays: Arrays, metadata: Metadata) -> Self:
        """Restore a tree of this class from its `state`; ProtocolError if the state is invalid."""
        try:
            tree = cls(int(metadata["size"]))
            for i, node in enumerate(metadata["nodes"]):
                level, count, energy = int(node["level"]), int(node["count"]), float.fromhex(node["energy"])
                tree.nodes.append(Node(level, arrays[f"rows.{i}"], count, arrays[f"sum.{i}"], energy))
            pending = arrays["pending"]
            tree._check(pending)
            tree._leaf, tree._filled = tree._checked(pending), len(pending)
        except (AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
            raise ProtocolError(f"not the state of a coreset tree ({error!r}): use an older copy of the file") from None
        return tree

    def _append(self, rows: np.ndarray) -> None:
        """Add rows to the next leaf, which has room for them."""
        if not self._filled:  # the previous array belongs to a node
            self._leaf = np.empty((self.size, rows.shape[1]), np.float32)
        elif self._filled == len(self._leaf):  # the pending rows of a loaded or copied tree
            self._leaf = np.vstack([self._leaf, np.empty((self.size - self._filled, rows.shape[1]), np.float32)])
        self._leaf[self._filled : self._filled + len(rows)] = rows
        self._filled += len(rows)

    def _push(self, node: Node) -> None:
        nodes = [*self.nodes, node]
        while len(nodes) > 1 and self._to_merge(nodes[-2], nodes[-1]):
            nodes[-2:] = [self._merged(nodes[-2], nodes[-1])]
        self.nodes = nodes  # one assignment: Ctrl-C during a reduction loses no node

    def _to_merge(self, older: Node, newer: Node) -> bool:
        """Return True if two neighbouring nodes are to be merged into one."""
        return older.level == newer.level

    def _merged(self, older: Node, newer: Node) -> Node:
        return older.merged(newer)

    def _is_count(self, count: int, level: int) -> bool:
        """Return True if a node of this level can summarise this number of rows."""
        return count == self.size << level

    def _checked(self, rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows, np.float32)
        if rows.ndim != 2 or (self.width and rows.shape[1] != self.width):
            raise ProtocolError(
                f"expected rows float32 (k, {self.width or 'd'}), got {rows.shape}: insert rows of one length"
            )
        if not np.isfinite(rows).all():  # without BLAS, whose threads are not limited here
            raise ProtocolError("rows contain a number that is not finite: insert finite rows")
        return rows

    def _check(self, pending: np.ndarray) -> None:
        """Raise ValueError unless the nodes, and the pending rows that follow them, can be a tree."""
        levels = [node.level for node in self.nodes]
        if levels != sorted(set(levels), reverse=True):
            raise ValueError(f"levels {levels} are not strictly decreasing")
        if pending.ndim != 2 or pending.dtype != np.float32 or len(pending) >= self.size:
            raise ValueError(f"pending rows of {pending.dtype} {pending.shape}")
        for node in self.nodes:
            has_shape = node.rows.shape == (self.size, self.width) and node.sum.shape == (self.width,)
            if not has_shape or node.rows.dtype != np.float32 or node.sum.dtype != np.float64:
                raise ValueError(f"a node of {node.rows.dtype} {node.rows.shape}")
            if not 0 <= node.level < _LEVELS or not self._is_count(node.count, node.level):
                raise ValueError(f"a node of level {node.level} and {node.count} rows")
            if not (is_finite(node.rows) and is_finite(node.sum) and np.isfinite(node.energy)):
                raise ValueError(f"a node of level {node.level} with numbers that are not finite")


class FrequentDirections(CoresetTree):
    """A sketch of a stream of rows in constant memory (Liberty 2013; Ghashami et al. 2016).

    It stores one node of n rows and fewer than n pending rows: a new leaf is stacked below the node, and the 2n rows
    are shrunk to n, see `catstream.coreset.reduce.shrink`. In addition to the bound of a tree, for every unit
    vector y, `0 <= ||A y||^2 - ||C y||^2 <= c / (n + 1) <= ||A||^2 / (n + 1)`, up to rounding, for one stream and for
    merged ones. Here c is `dropped_energy`, larger than in a coreset tree because all directions are shrunk.

    >>> sketch = FrequentDirections(size=4)
    >>> sketch.insert(np.eye(13, 5, dtype=np.float32))
    >>> [node.count for node in sketch.nodes], len(sketch.pending), sketch.rows_seen
    ([12], 1, 13)
    """

    def _to_merge(self, *_: Node) -> bool:
        return True

    def _merged(self, older: Node, newer: Node) -> Node:
        total, count = older.sum + newer.sum, older.count + newer.count
        rows = shrink(np.vstack([older.rows, newer.rows]), self.size, total, older.products_with(newer))
        return Node((count // self.size).bit_length() - 1, rows, count, total, older.energy + newer.energy)

    def _is_count(self, count: int, level: int) -> bool:
        leaves, rest = divmod(count, self.size)
        return not rest and leaves.bit_length() == level + 1


def pack_trees(trees: Mapping[str, CoresetTree]) -> tuple[Arrays, Metadata]:
    """Arrays and metadata of several trees; the names of arrays begin with the name of their tree."""
    arrays: Arrays = {}
    metadata: Metadata = {}
    for name, tree in trees.items():
        own, metadata[name] = tree.state()
        arrays |= {f"{name}.{key}": array for key, array in own.items()}
    return arrays, metadata


def unpack_trees(arrays: Arrays, metadata: Metadata) -> dict[str, CoresetTree]:
    """Restore trees that `pack_trees` packed; ProtocolError if they are invalid."""
    return {
        name: CoresetTree.from_state(storage.with_prefix(arrays, f"{name}."), state) for name, state in metadata.items()
    }
