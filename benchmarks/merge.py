"""Merges two models of one object: learned from the first and from the second third of a sequence, tried in the last.

They are compared with one tree that has seen both thirds. `best` is the share of frames in which the window with the
highest score in the whole frame, at the true size, overlaps the object by half; no tracker is involved. `found` is the
share of frames in which a run that starts with the model has a box that overlaps the true one by half.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice
from statistics import fmean

import numpy as np
from learning import chosen, each, features, hits, learning_command, model_of, tracked
from table import Table, benchmark, mean_and_error

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.compression.reduce import energy
from catstream.evaluation.datasets import Sequence
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap
from catstream.jobs.saved_model import SavedModel, merge

_EVERY = 5  # frames from one to the next in which the best window is looked up

#: Of each model: share of frames with the best window on the object, and share in which a run finds it.
Row = dict[str, tuple[float, float]]


def measured(task: tuple[Sequence, int]) -> tuple[str, Row, float, float] | None:
    """Measure the four models of a sequence; None if the object is absent where a third starts."""
    sequence, frames = task
    third, settings = max(len(sequence) // 3, 1), Settings()
    if not np.isfinite(sequence.boxes[[0, third]]).all() or len(sequence) < 2 * third + 1:
        return None
    halves = [features(sequence, start, third, settings) for start in (0, third)]
    first, second = (model_of(half, settings) for half in halves)
    merged, one = merge([first, second], force=True), model_of([*halves[0], *halves[1]], settings)
    models = {"first third": first, "second third": second, "merged": merged, "one tree": one}
    row = {}
    for name, learned in models.items():
        found = hits(tracked(learned, sequence, 2 * third, frames), sequence, 2 * third)
        row[name] = best(learned, sequence, 2 * third, frames), sum(found) / max(len(found), 1)
    return sequence.name, row, *differences(merged, one)


def best(learned: SavedModel, sequence: Sequence, start: int, count: int) -> float:
    """The share of frames in which the window with the highest score overlaps the object by half."""
    found = []
    for image, truth in islice(zip(sequence.frames(start), sequence.boxes[start:], strict=True), 0, count, _EVERY):
        if np.isfinite(truth).all():
            box, context = Box(*map(float, truth)), learned.settings.search.context
            window = ScoreMap.whole(Pyramid(image), Window.around(box, context), learned.model).best()[1]
            found.append(window.box(context).overlap(box) > 0.5)
    return fmean(found) if found else 0.0


def differences(merged: SavedModel, one: SavedModel) -> tuple[float, float]:
    """Difference of the energy along the weights, in percent of c; and c, in percent of the energy of all rows."""
    trees = merged.trees["object"], one.trees["object"]
    ours, theirs = ([*(node.rows for node in tree.nodes), tree.pending] for tree in trees)
    weights = one.model.weights / np.linalg.norm(one.model.weights)
    along = [energy((np.vstack(rows) @ weights)[:, None]) for rows in (ours, theirs)]
    lost = max(tree.dropped_energy for tree in trees)
    whole = energy(np.vstack(theirs)) + trees[1].dropped_energy
    return 100 * abs(along[0] - along[1]) / max(lost, 1e-12), 100 * lost / whole


def figures(options: argparse.Namespace) -> Iterator[Table]:
    tasks = [(sequence, 4 if options.quick else options.frames) for sequence in chosen(options)]
    found = [row for row in each(options, measured, tasks) if row is not None]
    names = list(found[0][1])
    columns = [[row[name][k] for _, row, *_ in found] for name in names for k in (0, 1)]
    heads = ("sequence", *(f"{name}: {measure}" for name in names for measure in ("best", "found")), "% of c", "c, %")
    rows = [
        (name, *(value for model in row.values() for value in model), share, lost) for name, row, share, lost in found
    ]
    means = ("mean", *map(fmean, columns), fmean(row[2] for row in found), fmean(row[3] for row in found))
    note = f"{len(found)} sequences; `% of c`: | ||C w||^2 - ||C' w||^2 | / c of the object's trees, merged and one"
    yield Table("Models of the parts of a sequence", heads, [*rows, means], note)
    yield Table("Merged against the others", ("difference", "best", "± s.e.", "found", "± s.e."), list(_paired(found)))


def _paired(found: list[tuple[str, Row, float, float]]) -> Iterator[tuple]:
    for other in ("first third", "second third", "one tree"):
        pairs = (mean_and_error(row["merged"][k] - row[other][k] for _, row, *_ in found) for k in (0, 1))
        yield f"merged - {other}", *(cell or 0.0 for pair in pairs for cell in pair)


if __name__ == "__main__":
    benchmark(figures, learning_command(__doc__))
