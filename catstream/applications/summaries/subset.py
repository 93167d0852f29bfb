"""Row subset selection: the k of m candidate rows whose span keeps most of the energy of other rows.

For candidates X and target rows B, a subset S is chosen to maximise ||B P||^2, with P the projection on the span of S.
Only the products X X' and B X' are used. The greedy choice is that of Farahat et al. (2011); the exchange afterwards
replaces each chosen row by the candidate that keeps more.
"""

from __future__ import annotations

import numpy as np

from catstream.numerics.arrays import Float64

__all__ = ["choose", "exchange"]

_DEPENDENT = 1e-6  # share of a row's energy outside a span below which it counts as inside
_BETTER = 1 + 1e-9  # factor of energy by which an exchange has to be better, so that rounding does not go on for ever
_ROUNDS = 3


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

    Costs O(k m l) each round and O(k m l) for each replacement. The chosen rows have to be linearly independent, as
    those of `choose` are.
    """
    chosen = list(chosen)
    span = _Span(gram, products, chosen)
    for _ in range(_ROUNDS):
        before = list(chosen)
        for place, number in enumerate(before):
            gains = span.gains_without(place)
            best = int(gains.argmax())
            if gains[best] > _BETTER * gains[number]:
                chosen[place] = best
                span = _Span(gram, products, chosen)
        if chosen == before:
            break
    return chosen


class _Span:
    """The span of chosen rows x_i, with the dual vectors z_i in it: z_i x_j' is 1 if i = j, otherwise 0.

    If x_i is left out, the span loses the direction z_i.
    """

    def __init__(self, gram: Float64, products: Float64, chosen: list[int]) -> None:
        self._least = _DEPENDENT * gram.diagonal()
        inverse = np.linalg.inv(gram[np.ix_(chosen, chosen)])
        self._squares = inverse.diagonal()  # ||z_i||^2
        self._inner: Float64 = inverse @ gram[chosen]  # z_i x_p'
        self._outer: Float64 = products[:, chosen] @ inverse  # B z_i'
        self._own = gram.diagonal() - np.sum(gram[chosen] * self._inner, axis=0)  # ||x_p||^2 outside the span
        self._rest = products - products[:, chosen] @ self._inner  # B x_p' outside the span
        self._rest_squares = np.sum(self._rest**2, axis=0)

    def gains_without(self, place: int) -> Float64:
        """Energy that each candidate adds to the chosen ones without that at `place`; 0 for those."""
        inner, outer = self._inner[place] / self._squares[place], self._outer[:, place]
        own = self._own + inner * self._inner[place]
        energies = self._rest_squares + 2 * inner * (outer @ self._rest) + (outer @ outer) * inner**2
        gains: Float64 = np.divide(energies, own, out=np.zeros(len(own)), where=own > self._least)
        return gains
