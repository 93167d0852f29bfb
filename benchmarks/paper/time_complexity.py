"""The paper's figure of time complexity: training with the coreset against training with all points.

Points are rows of the object from a real video, affine copies included. On the left the paper shows the time of one
training against the points so far: constant with the coreset. On the right the time to build the tree, a point:
constant on average, at several n. Its figure prints no numbers.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from time import perf_counter

import numpy as np
import shared  # noqa: F401
from sequences import named
from table import Table, benchmark, command

from catstream.base.box import Window
from catstream.coreset.tree import CoresetTree
from catstream.detection.teacher import affine_copies
from catstream.features.layout import ROW_LENGTH
from catstream.features.pyramid import Pyramid
from catstream.measure.datasets import Sequence
from catstream.training.one_class import one_class

SIZES = (32, 64, 128, 256)
_ORIGIN = np.zeros(ROW_LENGTH, np.float32)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    points = 512 if options.quick else options.points
    rows = points_of(named(options, "TLD_10_panda"), points)
    counts = [count for count in (256 << k for k in range(20)) if count <= points]
    training = []
    for count in counts:
        samples = [grown(rows[:count], n).sample().rows for n in SIZES[1:3]]
        training.append((count, *(seconds(one_class, part, _ORIGIN) * 1000 for part in (rows[:count], *samples))))
    columns = ("points", "all points, ms", *(f"coreset, n = {n}, ms" for n in SIZES[1:3]))
    yield Table("One training of the one-class SVM", columns, training)

    building = [(count, *(seconds(grown, rows[:count], n) / count * 1e6 for n in SIZES)) for count in counts]
    columns = ("points", *(f"n = {n}, us" for n in SIZES))
    yield Table("Building the tree, a point", columns, building)


def points_of(sequence: Sequence, count: int) -> np.ndarray:
    """Return rows of the object, float32 (count, d), with as many copies from each frame as needed."""
    present = int(np.isfinite(sequence.boxes).all(axis=1).sum())
    copies, rng = -(-count // present), np.random.default_rng(0)
    rows = [
        affine_copies(Pyramid(image), Window(*box), copies, rng)
        for image, box in zip(sequence.frames(), sequence.boxes, strict=True)
        if np.isfinite(box).all()
    ]
    return np.vstack(rows)[:count]


def grown(rows: np.ndarray, n: int) -> CoresetTree:
    """Return a tree of all rows, inserted one by one."""
    tree = CoresetTree(n)
    for row in rows:
        tree.insert(row[None])
    return tree


def seconds(work: Callable[..., object], *arguments: object) -> float:
    """Return the minimum time of three runs, which other load of the machine affects least."""
    times = []
    for _ in range(3):
        begin = perf_counter()
        work(*arguments)
        times.append(perf_counter() - begin)
    return min(times)


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        points=(8192, "maximum number of points"),
    )
