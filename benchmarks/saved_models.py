"""Starts with a saved model: in the rest of the sequence that it was learned from, and in other sequences.

Each model is learned from the first third of its sequence. In the rest, the object should be found, at the right size.
In other sequences, any box is a false one; sequences with the same people or the same scene are not paired.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from statistics import fmean

import numpy as np
from learning import chosen, each, features, hits, learning_command, model_of, tracked, training_frames
from table import Table, benchmark, mean_and_error

from catstream.base.settings import Settings
from catstream.evaluation.datasets import Sequence

_STEPS = (1, 4, 7, 10, 13, 16, 19, 22)  # distances, in the list, of the other sequences that a model is tried in

#: Of one model: name, frames, hits, false boxes, size of the first box; boxes in other sequences, and their frames.
Row = tuple[str, int, int, int, float | None, int, int]


def measured(task: tuple[Sequence, list[Sequence], int]) -> Row:
    """Measure the model of one sequence."""
    own, others, frames = task
    count = training_frames(own)
    learned = model_of(features(own, 0, count, Settings()), Settings())
    tracks = tracked(learned, own, count, frames)
    found = hits(tracks, own, count)
    boxes = [(track.box, truth) for track, truth in zip(tracks, own.boxes[count:], strict=False) if track.box]
    size = None
    if boxes and np.isfinite(boxes[0][1]).all():
        size = float(np.sqrt(boxes[0][0].area / (boxes[0][1][2] * boxes[0][1][3])))
    strangers = [track for other in others for track in tracked(learned, other, 0, frames)]
    wrong = len(boxes) - sum(found)
    return own.name, len(found), sum(found), wrong, size, sum(map(bool, (t.box for t in strangers))), len(strangers)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    found = chosen(options)
    tasks = []
    for i, own in enumerate(found):
        others = [found[(i + step) % len(found)] for step in _STEPS[: options.others]]
        others = [other for other in others if other.name[:11] != own.name[:11]]
        tasks.append((own, others, 4 if options.quick else options.frames))
    rows = [
        (name, seen / max(frames, 1), wrong / max(frames, 1), size, strangers / max(tried, 1))
        for name, frames, seen, wrong, size, strangers, tried in each(options, measured, tasks)
    ]
    columns = ("model of", "found", "wrong", "size of the first box", "stranger")
    note = "shares of frames; size relative to the true one; `stranger` is of frames of other sequences"
    yield Table("Runs that start with a saved model", columns, [*rows, *_summary(rows)], note)


def _summary(rows: list[tuple]) -> Iterator[tuple]:
    """The mean over the models, and its standard error; the size is the mean factor away from the true one."""
    (found, wrong, strangers), errors = zip(*(mean_and_error(row[k] for row in rows) for k in (1, 2, 4)), strict=True)
    sizes = [abs(np.log(row[3])) for row in rows if row[3] is not None]
    yield "mean", found, wrong, float(np.exp(fmean(sizes))) if sizes else None, strangers
    if len(rows) > 1:
        yield "± standard error", errors[0], errors[1], None, errors[2]


if __name__ == "__main__":
    benchmark(figures, learning_command(__doc__), others=(4, "other sequences for each model"))
