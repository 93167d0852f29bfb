"""Accuracy with the features of networks beside HOG, and without, over several first boxes of each sequence.

Each file of `--networks` is one of `catstream network prepare`, and has the name of its network.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

from accuracy import accuracy_command, compared, described, videos
from sequences import CHECK
from table import Cell, Table, benchmark, mean_and_error

from catstream.base.settings import Settings
from catstream.evaluation.accuracy import Row, rows_of

MEASURES = ("auc", "success")
COLUMNS = ("sequences", "", "features", *(word for measure in ("AUC", "success") for word in (measure, "gained", "±")))


def figures(options: argparse.Namespace) -> Iterator[Table]:
    variants = {"HOG and colours": Settings()}
    variants |= {file.stem: Settings(features={"network": str(file)}) for file in options.networks}
    found = {name: rows_of(runs) for name, runs in compared(options, videos(options), variants).items()}
    note = f"{described(options)} of each sequence; gained: beside HOG and colours alone; ±: the standard error"
    means: list[list[Cell]] = []
    for group, members in (("tuning", False), ("check list, *", True), ("all", None)):
        rows = {name: [row for row in of if members in (row.name in CHECK, None)] for name, of in found.items()}
        if rows["HOG and colours"]:
            means += ([group, *cells] for cells in beside(rows))
    yield Table("Means", COLUMNS, means, note)
    heads = ("sequence", *(f"{measure}, {name}" for name in found for measure in ("AUC", "success")))
    yield Table("Each sequence", heads, list(by_sequence(found)))


def beside(found: dict[str, list[Row]]) -> Iterator[list[Cell]]:
    """Yield a row for each variant: means, and differences to the first variant."""
    for name, rows in found.items():
        cells: list[Cell] = [len(rows), name]
        for measure in MEASURES:
            values = [getattr(row, measure) for row in rows]
            before = [getattr(row, measure) for row in next(iter(found.values()))]
            cells += [fmean(values), *mean_and_error(after - each for after, each in zip(values, before, strict=True))]
        yield cells


def by_sequence(found: dict[str, list[Row]]) -> Iterator[list[Cell]]:
    """Yield a row for each sequence: the measures of each variant."""
    for rows in zip(*found.values(), strict=True):
        name = rows[0].name
        yield [f"{name} *" if name in CHECK else name, *(getattr(row, measure) for row in rows for measure in MEASURES)]


if __name__ == "__main__":
    parser = accuracy_command(__doc__)
    parser.add_argument("--networks", type=Path, nargs="+", default=[], metavar="FILE", help="files of networks")
    benchmark(figures, parser)
