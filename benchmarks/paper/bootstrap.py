"""The paper's bootstrap and ours: accuracy until the first model is trained.

The paper begins with SCM, a sparse collaborative model in a particle filter, for the first n frames; we with affine
copies of the first box and ridge regression, and learn from the first leaf on. Both follow the same n frames, from
several places of each sequence. The paper prints no figures of its bootstrap alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import shared  # noqa: F401
from accuracy import MEANS, accuracy_command, compared, difference, means, starts_of, videos
from table import Table, benchmark

from catstream.base.settings import Settings
from catstream.evaluation.datasets import Sequence, Start

#: Bootstrap -> its settings. SCM follows all n frames where each gives one row: no copies.
BOOTSTRAPS: dict[str, dict[str, Any]] = {"copies": {}, "scm": {"training.bootstrap": "scm", "training.copies": 0}}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    base = Settings(coreset={"size": options.size})
    starts = starts_of(options)
    pieces = [piece for found in videos(options) for piece in pieces_of(found, starts(found), options.size)]
    options.starts = 1  # for each piece
    runs = compared(options, pieces, {name: base.replace(changes) for name, changes in BOOTSTRAPS.items()})
    rows = []
    for name, found in runs.items():
        rate = sum(len(run.seconds) for run in found) / sum(float(run.seconds.sum()) for run in found)
        rows.append((name, *means(found), *difference(found, runs["scm"]), rate))
    columns = ("bootstrap", *MEANS, "AUC above scm", "± standard error", "frames/s")
    yield Table(f"The first {options.size} frames", columns, rows, f"{len(pieces)} pieces")


def pieces_of(sequence: Sequence, starts: list[Start], frames: int) -> list[Sequence]:
    """Cut `frames` frames from several places where the object is present, as sequences of their own."""
    return [
        replace(
            sequence,
            name=f"{sequence.name}-{start.frame}",
            boxes=sequence.boxes[start.frame : start.frame + frames],
            begin=sequence.begin + start.frame,
        )
        for start in starts
    ]


if __name__ == "__main__":
    benchmark(figures, accuracy_command(__doc__, starts=3), size=(64, "n, in frames and rows"))
