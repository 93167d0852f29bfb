"""Table 3 of the paper: learning from the root of the tree only, against hierarchical sampling of all its nodes.

The paper follows the CVPR2013 benchmark, we the sequences that are there; once the paper's way (one-class SVM, the
whole frame searched), once with our settings.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import shared  # noqa: F401
from accuracy import MEANS, TrackerRun, accuracy_command, described, means, rows_of, spread, videos
from assembled import Recipe, follow_all
from table import Table, benchmark

from catstream.base.settings import PRESETS, Settings
from catstream.coreset.node import sample
from catstream.coreset.tree import CoresetTree
from catstream.wire.messages import Summary

#: Training set -> success and precision in the paper.
PAPER = {"root": (0.398, 0.434), "hierarchy": (0.524, 0.677)}

ENDS = ("worst", "its success", "best", "its success")


class RootTree(CoresetTree):
    """A tree whose sample is its root only: newer rows are not used until they are merged into it."""

    def sample(self) -> Summary:
        root = self.nodes[0]
        mean = (root.sum / root.count).astype(root.rows.dtype)
        return Summary(sample([root], self.size), mean, root.count, (root.level,))


def figures(options: argparse.Namespace) -> Iterator[Table]:
    recipes = {}
    for source, tree in (("root", RootTree), ("hierarchy", CoresetTree)):
        if not options.ours:
            recipes[f"paper's way, {source}"] = Recipe(Settings.from_values(PRESETS["one-class-paper"]), tree)
        recipes[f"our settings, {source}"] = Recipe(Settings(), tree)
    runs = follow_all(options, videos(options), recipes)
    rows = [
        (name, *means(found), spread(found), *ends(found), *PAPER[name.split(", ")[1]]) for name, found in runs.items()
    ]
    columns = ("learned from", *MEANS, "spread of AUC", *ENDS, "paper: success", "paper: precision")
    yield Table("Root or hierarchy", columns, rows, f"{described(options)} of each sequence")


def ends(runs: list[TrackerRun]) -> Iterator[str | float]:
    """Yield the names and the success of the worst and of the best sequence."""
    ranked = sorted(rows_of(runs), key=lambda row: row.success)
    for row in (ranked[0], ranked[-1]):
        yield from (row.name, row.success)


if __name__ == "__main__":
    benchmark(figures, accuracy_command(__doc__, starts=3), ours=(False, "only with our settings"))
