"""Selects the k rows of a stream that keep most of its energy, in one pass and constant memory.

The subset S of candidate rows X is chosen to maximise ||B P||^2, with P the projection on the span of S and a sketch B
of the stream. Only the products X X' and B X' are used. The greedy choice is that of Farahat et al. (2011); the
exchange afterwards replaces each chosen row by the candidate that keeps more.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Generic, TypeVar

import numpy as np

from catstream.compression.reduce import energy
from catstream.compression.tree import FrequentDirections
from catstream.errors import SettingsError
from catstream.numerics.arrays import Float32, Float64

_Key = TypeVar("_Key")

_LEAST_SIZE = 128  # rows of the sketch, if k is small
_DEPENDENT = 1e-6  # share of a row's energy outside a span below which it counts as inside
_BETTER = 1 + 1e-9  # factor of energy by which an exchange has to be better, so that rounding does not go on for ever
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Selection(Generic[_Key]):
    """The selected rows (images) of a stream A, in the order in which they add most energy.

    Attributes
    ----------
    selected : list
        Their keys: for `catstream.summarize`, the numbers of the images.
    energies : list of float
        Share of ||A||^2 that each adds to those before it.
    count : int
        Number of rows of the stream.
    kept, kept_at_most : float
        Bounds of the share ||A P||^2 / ||A||^2, with P the projection on the span of the selected rows. Their
        difference is the error of the sketch.
    """

    selected: list[_Key]
    energies: list[float]
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
    >>> selection.result().selected
    ['c', 'b']
    """

    def __init__(self, k: int, size: int | None = None) -> None:
        self._size = max(_LEAST_SIZE, 2 * k) if size is None else size
        if not 1 <= k <= self._size:
            raise SettingsError(f"k images are selected with k from 1 to {self._size}, got {k}: give another k")
        self._k = k
        self._sketch = FrequentDirections(self._size)
        self._candidates: list[Float32] = []
        self._keys: list[_Key] = []  # of the candidates
        self.count = 0

    def add(self, row: np.ndarray, key: _Key) -> None:
        """Add the next row of the stream.

        Parameters
        ----------
        row : (d,), finite numbers
        key : returned if the row is selected
        """
        candidate = np.array(row, np.float32)
        self._sketch.insert(candidate[None])
        self._candidates.append(candidate)
        self._keys.append(key)
        self.count += 1
        if len(self._candidates) == 2 * self._size:
            chosen, _ = choose(*self._products(), self._size)
            remaining = sorted(self._completed(chosen, self._size))
            self._candidates = [self._candidates[number] for number in remaining]
            self._keys = [self._keys[number] for number in remaining]

    def result(self) -> Selection[_Key]:
        """The selection among all rows so far; the stream may continue.

        Raises
        ------
        SettingsError
            If there were fewer than k rows.
        """
        if self.count < self._k:
            raise SettingsError(f"k = {self._k} images cannot be selected from {self.count}: give a smaller k")
        gram, products = self._products()
        chosen = exchange(gram, products, choose(gram, products, self._k)[0])
        order, energies = choose(gram[np.ix_(chosen, chosen)], products[:, chosen], len(chosen))
        whole = sum(node.energy for node in self._sketch.nodes) + energy(self._sketch.pending) or 1.0
        shares = [each / whole for each in energies] + [0.0] * (self._k - len(energies))
        keys = [self._keys[number] for number in self._completed([chosen[place] for place in order], self._k)]
        kept = min(sum(shares), 1.0)
        error = min(1.0, self._k / (self._size + 1)) * max(self._sketch.dropped_energy, 0.0) / whole
        return Selection(keys, shares, self.count, kept, min(kept + error, 1.0))

    def _products(self) -> tuple[Float64, Float64]:
        """Products of the candidates with one another, and of the sketch with them."""
        candidates = np.array(self._candidates, np.float64)
        sketch = np.vstack([*(node.rows for node in self._sketch.nodes), self._sketch.pending])
        return candidates @ candidates.T, sketch @ candidates.T

    def _completed(self, chosen: list[int], count: int) -> list[int]:
        """Complete chosen candidates by others to a number: rows that fewer rows span may be selected, too."""
        taken = set(chosen)
        others = (number for number in range(len(self._keys)) if number not in taken)
        return [*chosen, *islice(others, count - len(chosen))]


def choose(gram: Float64, products: Float64, k: int) -> tuple[list[int], list[float]]:
    """Choose at most `k` candidates one after the other, each time the one that adds most energy.

    Costs O(k m (m + l)).

    Parameters
    ----------
    gram : float64 (m, m), X X'
    products : float64 (l, m), B X'

    Returns
    -------
    chosen : their numbers, strongest first; fewer than `k` if the others are in the span of these
    energies : energy of B that each adds to the ones before

    >>> rows = np.array([[0, 2.0], [3, 0], [1, 0]])
    >>> choose(rows @ rows.T, rows @ rows.T, 3)
    ([1, 0], [10.0, 4.0])
    """
    gram, products, least = gram.copy(), products.copy(), _DEPENDENT * gram.diagonal()
    chosen: list[int] = []
    energies: list[float] = []
    while len(chosen) < k:
        own = gram.diagonal()
        gains = np.divide(np.sum(products**2, axis=0), own, out=np.zeros(len(own)), where=own > least)
        best = int(gains.argmax())
        if not gains[best] > 0:
            break
        chosen.append(best)
        energies.append(float(gains[best]))
        inner, outer = gram[:, best] / np.sqrt(own[best]), products[:, best] / np.sqrt(own[best])
        gram -= np.outer(inner, inner)
        products -= np.outer(outer, inner)
    return chosen, energies


def exchange(gram: Float64, products: Float64, chosen: list[int]) -> list[int]:
    """Replace chosen candidates, one at a time, as long as another one keeps more energy; at most a few rounds.

    Costs O(k^2 m (k + l)) each round. The chosen rows have to be linearly independent, as those of `choose` are.
    """
    chosen = list(chosen)
    for _ in range(_ROUNDS):
        before = list(chosen)
        for place, number in enumerate(before):
            gains = _gains(gram, products, chosen[:place] + chosen[place + 1 :])
            best = int(gains.argmax())
            if gains[best] > _BETTER * gains[number]:
                chosen[place] = best
        if chosen == before:
            break
    return chosen


def _gains(gram: Float64, products: Float64, chosen: list[int]) -> Float64:
    """Energy that each candidate adds to the span of chosen ones; 0 for those."""
    shares = np.linalg.solve(gram[np.ix_(chosen, chosen)], gram[chosen])
    own = gram.diagonal() - np.sum(gram[chosen] * shares, axis=0)  # outside the span
    rest = products - products[:, chosen] @ shares
    outside = own > _DEPENDENT * gram.diagonal()
    gains: Float64 = np.divide(np.sum(rest**2, axis=0), own, out=np.zeros(len(own)), where=outside)
    return gains
