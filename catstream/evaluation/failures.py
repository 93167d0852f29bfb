"""FailureStrip strips: a few frames around the place where a run went wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from catstream.evaluation.metrics import overlaps
from catstream.evaluation.runs import EvaluationRun
from catstream.video.annotate import thumbnail

__all__ = ["FailureStrip", "failure_strip", "worst_runs"]

#: Frames shown, counted from the first bad one; the last bad one is shown too.
_AROUND = (-20, -5, 0, 5, 20)
_WIDTH = 240


@dataclass(frozen=True, slots=True, eq=False)
class FailureStrip:
    """What went wrong in a run, for people to look at.

    run        shown
    first      row of the run where its longest stretch of bad frames begins
    length     of that stretch in frames
    pictures   (row, JPEG bytes) in order; the truth is white, the tracker's box orange
    """

    run: EvaluationRun
    first: int
    length: int
    pictures: list[tuple[int, bytes]]


def worst_runs(runs: list[EvaluationRun], count: int) -> list[EvaluationRun]:
    """At most `count` runs with the most bad frames for their length, the worst first; good ones are left out."""
    shares = [_bad(run).mean() for run in runs]
    order = np.argsort(shares, kind="stable")[::-1][:count]
    return [runs[place] for place in order if shares[place] > 0.05]


def failure_strip(run: EvaluationRun) -> FailureStrip:
    """The film of one run; reads the frames it needs."""
    first, length = _longest(_bad(run))
    last = len(run.boxes) - 1
    wanted = sorted({0, *(min(max(first + step, 0), last) for step in _AROUND), first + length - 1})
    pictures = []
    for row, image in enumerate(run.sequence.frames(run.start)):
        if row in wanted:
            pictures.append((row, thumbnail(image, run.truth[row], run.boxes[row], _WIDTH)))
        if row == wanted[-1]:
            break
    return FailureStrip(run, first, length, pictures)


def _bad(run: EvaluationRun) -> np.ndarray:
    """Frames where the overlap is 0.5 or less, or where something is found that is not there, bool (frames,)."""
    there = np.isfinite(run.truth).all(axis=1)
    found = np.isfinite(run.boxes).all(axis=1)
    return np.where(there, overlaps(run.boxes, run.truth) <= 0.5, found)


def _longest(bad: np.ndarray) -> tuple[int, int]:
    """First frame and length of the longest stretch of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(int), [0]])))
    begins, ends = edges[::2], edges[1::2]
    if not len(begins):
        return 0, 1
    best = int((ends - begins).argmax())
    return int(begins[best]), int(ends[best] - begins[best])
