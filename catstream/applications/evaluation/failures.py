"""Film strips of failures: a few frames around the longest failure of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from catstream.applications.evaluation.metrics import overlaps
from catstream.applications.evaluation.runs import EvaluationRun
from catstream.numerics.arrays import Bool
from catstream.video.annotate import thumbnail

#: The frames shown, relative to the first frame of the failure; its last frame is shown too.
_AROUND = (-20, -5, 0, 5, 20)
_WIDTH = 240


@dataclass(frozen=True, slots=True, eq=False)
class FailureStrip:
    """Images of the longest failure of a run, for people to look at.

    run        the run
    first      first row of its longest failure
    length     number of consecutive failed frames
    pictures   (row, JPEG file) in order; the ground truth is white, the tracker's box orange
    """

    run: EvaluationRun
    first: int
    length: int
    pictures: list[tuple[int, bytes]]


def worst_runs(runs: list[EvaluationRun], count: int) -> list[EvaluationRun]:
    """Return at most `count` runs with the largest shares of failed frames, worst first; at least 5 % must fail."""
    shares = [_bad(run).mean() for run in runs]
    order = np.argsort(shares, kind="stable")[::-1][:count]
    return [runs[place] for place in order if shares[place] > 0.05]


def failure_strip(run: EvaluationRun) -> FailureStrip:
    """Make the film strip of a run. It reads the frames of the sequence."""
    first, length = _longest(_bad(run))
    last = len(run.boxes) - 1
    wanted = sorted({0, *(min(max(first + step, 0), last) for step in _AROUND), first + length - 1})
    pictures = []
    for row, image in enumerate(run.sequence.frames(run.start.frame)):
        if row in wanted:
            pictures.append((row, thumbnail(image, run.truth[row], run.boxes[row], _WIDTH)))
        if row == wanted[-1]:
            break
    return FailureStrip(run, first, length, pictures)


def _bad(run: EvaluationRun) -> Bool:
    """Return the failed frames, bool (frames,): overlap of at most 0.5, or a box although the object is absent."""
    there = np.isfinite(run.truth).all(axis=1)
    found = np.isfinite(run.boxes).all(axis=1)
    return np.where(there, overlaps(run.boxes, run.truth) <= 0.5, found)


def _longest(bad: Bool) -> tuple[int, int]:
    """Return the first index and the length of the longest run of true values."""
    runs = np.ma.clump_masked(np.ma.masked_where(bad, bad))
    longest = max(runs, key=lambda run: run.stop - run.start, default=slice(0, 1))
    return longest.start, longest.stop - longest.start
