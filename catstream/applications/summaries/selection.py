"""Selects the k rows of a stream that keep most of its energy, in one pass and constant memory."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Generic, TypeVar

import numpy as np

from catstream.applications.summaries.subset import choose, exchange
from catstream.compression.reduce import energy
from catstream.compression.tree import FrequentDirections
from catstream.errors import SettingsError
from catstream.numerics.arrays import Float32, Float64

__all__ = ["RowSelection", "Selected", "Selection"]

_Key = TypeVar("_Key")

_LEAST_SIZE = 128  # rows of the sketch, if k is small


@dataclass(frozen=True, slots=True)
class Selected(Generic[_Key]):
    """A selected row.

    key     the object that was given with the row
    energy  share of ||A||^2 that it adds to those of the rows selected before it
    """

    key: _Key
    energy: float


@dataclass(frozen=True, slots=True)
class Selection(Generic[_Key]):
    """The selected rows of a stream A, in the order in which they add most energy.

    count         number of rows of the stream
    kept          share ||A P||^2 / ||A||^2, with P the projection on the span of the selected rows: at least this
    kept_at_most  and at most this; the difference is the error of the sketch
    """

    rows: tuple[Selected[_Key], ...]
    count: int
    kept: float
    kept_at_most: float


class RowSelection(Generic[_Key]):
    """Selects the k rows of a stream A that keep most of ||A||^2, in one pass.

    It keeps a frequent-directions sketch B of n rows, and at most 2n candidates among the rows so far. Whenever there
    are 2n, the n that keep most of ||B||^2 remain. At the end, k are chosen of these in the same way. Memory is O(n d),
    and does not grow with the stream. Since 0 <= ||A P||^2 - ||B P||^2 <= min(1, k / (n + 1)) (||A||^2 - ||B||^2) for a
    projection P on k directions, the energy that is kept is known within this error without a second pass.

    Parameters
    ----------
    k : number of rows to select, at least 1
    size : n; None for max(128, 2k)

    Raises
    ------
    SettingsError
        If k is below 1, or above `size`.

    Examples
    --------
    >>> selection = RowSelection(k=2)
    >>> for key, row in zip("abc", ([1, 0, 0], [0, 2, 0], [2, 0.1, 0])):
    ...     selection.add(row, key)
    >>> [each.key for each in selection.selected().rows]
    ['c', 'b']
    """

    def __init__(self, k: int, size: int | None = None) -> None:
        self._size = max(_LEAST_SIZE, 2 * k) if size is None else size
        if not 1 <= k <= self._size:
            raise SettingsError(f"k images are selected with k from 1 to {self._size}, got {k}: give another k")
        self._k = k
        self._sketch = FrequentDirections(self._size)
        self._new: list[Float32] = []  # candidates that are not in the sketch yet
        self._keys: list[_Key] = []  # of the old candidates, then of the new ones
        self._old = np.empty((0, 0), np.float32)
        self.count = 0

    def add(self, row: np.ndarray, key: _Key) -> None:
        """Add the next row of the stream.

        Parameters
        ----------
        row : (d,), finite numbers
        key : returned if the row is selected
        """
        self._new.append(np.array(row, np.float32))
        self._keys.append(key)
        self.count += 1
        if len(self._new) == self._size:
            self._insert()
            if len(self._old) > self._size:
                chosen, _ = choose(*self._products(), self._size)
                self._keep(sorted(self._completed(chosen, self._size)))

    def selected(self) -> Selection[_Key]:
        """The selection among all rows so far; the stream may continue.

        Raises
        ------
        SettingsError
            If there were fewer than k rows.
        """
        if self.count < self._k:
            raise SettingsError(f"k = {self._k} images cannot be selected from {self.count}: give a smaller k")
        self._insert()
        gram, products = self._products()
        chosen = exchange(gram, products, choose(gram, products, self._k)[0])
        order, energies = choose(gram[np.ix_(chosen, chosen)], products[:, chosen], len(chosen))
        whole = sum(node.energy for node in self._sketch.nodes) + energy(self._sketch.pending) or 1.0
        shares = [each / whole for each in energies] + [0.0] * (self._k - len(energies))
        numbers = self._completed([chosen[place] for place in order], self._k)
        rows = tuple(Selected(self._keys[number], share) for number, share in zip(numbers, shares, strict=True))
        kept = min(sum(shares), 1.0)
        error = min(1.0, self._k / (self._size + 1)) * max(self._sketch.dropped_energy, 0.0) / whole
        return Selection(rows, self.count, kept, min(kept + error, 1.0))

    def _insert(self) -> None:
        """Insert the new candidates into the sketch."""
        if self._new:
            rows = np.array(self._new)
            self._sketch.insert(rows)
            self._old = np.vstack([self._old, rows]) if len(self._old) else rows
            self._new = []

    def _products(self) -> tuple[Float64, Float64]:
        """Products of the candidates with one another, and of the sketch with them."""
        candidates = self._old.astype(np.float64)
        sketch = np.vstack([*(node.rows for node in self._sketch.nodes), self._sketch.pending])
        return candidates @ candidates.T, sketch @ candidates.T

    def _completed(self, chosen: list[int], count: int) -> list[int]:
        """Complete chosen candidates by others to a number: rows that fewer rows span may be selected, too."""
        taken = set(chosen)
        others = (number for number in range(len(self._keys)) if number not in taken)
        return [*chosen, *islice(others, count - len(chosen))]

    def _keep(self, numbers: list[int]) -> None:
        self._old, self._keys = self._old[numbers], [self._keys[number] for number in numbers]
