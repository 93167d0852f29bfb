"""Chooses the k images that represent a folder, in one pass and constant memory: an outlook of the paper.

    python examples/summarise_images.py FOLDER [K]

Each image is a row of features, and A has the rows of all images. A frequent-directions sketch B of n rows, which is a
coreset tree with a single node, stands for A. The chosen images are those whose rows span a subspace with projection P
that keeps most of ||B||^2. For the share of ||A||^2 that they keep, at least `kept` and at most `kept_at_most` holds:

    0 <= ||A P||^2 - ||B P||^2 <= min(1, k / (n + 1)) (||A||^2 - ||B||^2)
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from catstream import FrequentDirections
from catstream.features.cells import Cells
from catstream.features.layout import CELL, WINDOW

_SIDE = WINDOW * CELL  # pixels of a window of the tracker
_DEPENDENT = 1e-6  # share of a row's energy outside a span below which it counts as inside


def describe(image: np.ndarray) -> np.ndarray:
    """Return the features of a whole image, as of a window of the tracker: float32 (d,)."""
    return Cells.of(cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)).row(0, 0)


def choose(rows: np.ndarray, sketch: np.ndarray, k: int) -> tuple[list[int], list[float]]:
    """Choose at most `k` rows one after the other, each time the one that adds most energy of the sketch.

    This is the greedy choice of Farahat et al. (2011), and costs O(k m (m + l)).

    Parameters
    ----------
    rows : (m, d), the candidates
    sketch : (l, d)

    Returns
    -------
    chosen : numbers of the rows, strongest first; fewer than `k` if the others are in the span of these
    energies : energy of the sketch that each adds to the ones before

    >>> candidates = np.array([[0, 2.0], [3, 0], [1, 0]])
    >>> choose(candidates, candidates, 3)
    ([1, 0], [10.0, 4.0])
    """
    gram, products = rows @ rows.T, sketch @ rows.T
    least = _DEPENDENT * gram.diagonal()
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
        gram = gram - np.outer(inner, inner)
        products = products - np.outer(outer, inner)
    return chosen, energies


@dataclass
class Summary:
    """The images that represent a stream of them; `size` is n, the rows of the sketch, and half of the candidates."""

    size: int = 128
    names: list[str] = field(default_factory=list)  # of the candidates
    rows: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.sketch = FrequentDirections(self.size)

    def add(self, name: str, image: np.ndarray) -> None:
        """Add the next image, uint8 (h, w, 3), blue green red."""
        row = describe(image)
        self.sketch.insert(row[None])
        self.names.append(name)
        self.rows.append(row)
        if len(self.rows) == 2 * self.size:
            remaining = sorted(self._choose(self.size)[0])
            self.names, self.rows = [self.names[k] for k in remaining], [self.rows[k] for k in remaining]

    def result(self, k: int) -> tuple[dict[str, float], float, float]:
        """Return the share of ||A||^2 that each of k images adds, and the bounds of what they keep together."""
        chosen, energies = self._choose(k)
        shares = {self.names[number]: each / self.sketch.energy for number, each in zip(chosen, energies, strict=True)}
        kept = min(sum(shares.values()), 1.0)
        error = min(1.0, k / (self.size + 1)) * self.sketch.dropped_energy / self.sketch.energy
        return shares, kept, min(kept + error, 1.0)

    def _choose(self, k: int) -> tuple[list[int], list[float]]:
        return choose(np.array(self.rows, float), self.sketch.rows.astype(float), k)


if __name__ == "__main__":
    summary = Summary()
    for file in sorted(Path(sys.argv[1]).iterdir()):
        if (picture := cv2.imread(str(file))) is not None:
            summary.add(file.name, picture)
    found, kept, kept_at_most = summary.result(int(sys.argv[2]) if len(sys.argv) > 2 else 10)
    for name, share in found.items():
        print(f"{share:7.2%}  {name}")
    print(f"{kept:.1%} of the energy of all images is kept, at most {kept_at_most:.1%}")
