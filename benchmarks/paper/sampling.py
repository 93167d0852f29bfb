"""Table 4 of the paper: coresets against samples of the same size, random ones (RS) and evenly spaced ones (SS).

The tracker learns from the first 25 ... 75 % of the frames, and only follows in the rest; success counts over all.
The samples have 2n rows, as many as the coreset's at most. The paper's n are 512, 768 and 1024, on videos of 2685
frames on average; ours are shorter. Once the paper's way (one-class SVM, the whole frame searched), with --ours as
we do it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import shared  # noqa: F401
from accuracy import accuracy_command, means, videos
from assembled import Recipe, follow_all
from table import Table, benchmark

from catstream.base.settings import PRESETS, Settings
from catstream.coreset.tree import CoresetTree
from catstream.wire.messages import Summary

SHARES = (0.25, 0.375, 0.5, 0.625, 0.75)

#: Success in the paper at n = 512, by share.
PAPER = {
    "coreset": (0.408, 0.449, 0.483, 0.534, 0.582),
    "evenly spaced": (0.332, 0.358, 0.396, 0.408, 0.424),
    "random": (0.218, 0.221, 0.251, 0.279, 0.301),
}


class Sampled(CoresetTree):
    """Has the interface and the schedule of a coreset tree, but its sample is a subset of the rows."""

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self.kept: list[np.ndarray] = []
        self.met = 0

    def insert(self, rows: np.ndarray) -> None:
        super().insert(rows)
        for row in rows:
            self.meet(row.copy())  # a copy, so that the other rows of the message are not kept in memory
            self.met += 1

    def meet(self, row: np.ndarray) -> None:
        """Decide whether to keep a row."""
        raise NotImplementedError

    def sample(self) -> Summary:
        few = np.linspace(0, len(self.kept) - 1, min(len(self.kept), 2 * self.size)).round().astype(int)
        rows = np.array(self.kept)[few]
        return replace(super().sample(), rows=rows, mean=rows.mean(axis=0))


class Random(Sampled):
    """Keeps a uniform random sample of 2n rows (Vitter's reservoir sampling)."""

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self.rng = np.random.default_rng(size)

    def meet(self, row: np.ndarray) -> None:
        if len(self.kept) < 2 * self.size:
            self.kept.append(row)
        elif (place := int(self.rng.integers(self.met + 1))) < len(self.kept):
            self.kept[place] = row


class Spaced(Sampled):
    """Keeps every k-th row, 2n to 4n rows: k doubles if there are more."""

    step = 1

    def meet(self, row: np.ndarray) -> None:
        if self.met % self.step == 0:
            self.kept.append(row)
        if len(self.kept) > 4 * self.size:
            self.kept, self.step = self.kept[::2], 2 * self.step


TREES = {"coreset": CoresetTree, "evenly spaced": Spaced, "random": Random}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    base = base_of(options)
    shares = SHARES[:1] if options.quick else SHARES
    for n in options.sizes[:1] if options.quick else options.sizes:
        recipes = {
            f"{name}, {share}": Recipe(base.replace({"coreset.size": n}), tree, share)
            for name, tree in TREES.items()
            for share in shares
        }
        runs = follow_all(options, videos(options, "TLD_"), recipes)
        rows = []
        for name, printed in PAPER.items():
            rows.append((name, *(means(runs[f"{name}, {share}"])[1] for share in shares)))
            rows.append((f"{name}, paper, n = 512", *printed[: len(shares)]))
        yield Table(f"Success, n = {n}, by share of frames learned from", ("learned from", *map(str, shares)), rows)


def base_of(options: argparse.Namespace) -> Settings:
    """Return all settings except n and the tree."""
    return Settings() if options.ours else Settings.from_values(PRESETS["one-class-paper"])


if __name__ == "__main__":
    benchmark(
        figures,
        accuracy_command(__doc__),
        base_of,
        sizes=([64, 256], "n"),
        ours=(False, "with our settings in place of the paper's"),
    )
