"""Table 5 of the paper: success on the TLD videos against the coreset's size, as a share of the video.

The paper follows ten videos, we those of them that are there; once as the paper does it (one-class SVM, the whole
frame searched, affine copies until the frames make 25 % of the video), once with our settings and that n. Its
tables 2 and 5 have the columns of Panda and Volkswagen the other way round; this is as table 5 prints it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import shared  # noqa: F401
from accuracy import accuracy_command, means, videos
from assembled import Recipe, follow_all
from table import Table, benchmark

from catstream.base.settings import PRESETS, Settings

#: Size in percent -> success in the paper: mean of ten videos, and Panda.
PAPER = {1: (0.49, 0.59), 2.5: (0.51, 0.59), 5: (0.53, 0.61), 10: (0.56, 0.62), 25: (0.66, 0.67)}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    found = videos(options, "TLD_")
    recipes, sizes = {}, list(PAPER)[-1:] if options.quick else list(PAPER)
    for percent in sizes:
        share = {"coreset.share": percent / 100}
        copies = {"training.copies": int(25 // percent) - 1}
        recipes[f"paper's, {percent} %"] = Recipe(Settings.from_values(PRESETS["one-class-paper"] | share | copies))
        recipes[f"ours, {percent} %"] = Recipe(Settings.from_values(share))
    runs = follow_all(options, found, recipes)
    rows = []
    for percent in sizes:
        theirs, ours = runs[f"paper's, {percent} %"], runs[f"ours, {percent} %"]
        panda = [run for run in theirs if "panda" in run.name]
        rows.append(
            (f"{percent} %", means(ours)[1], means(theirs)[1], means(panda)[1] if panda else None, *PAPER[percent])
        )
    columns = ("n", "ours: mean", "paper's way: mean", "paper's way: panda", "paper: mean of ten", "paper: Panda")
    yield Table("Success against the size of the coreset", columns, rows, f"we: {len(found)} videos of TLD")


if __name__ == "__main__":
    benchmark(figures, accuracy_command(__doc__, kept=False))
