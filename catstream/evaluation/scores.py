"""Measures of one-pass evaluation, as the public benchmarks define them.

They are computed from the boxes of a run and the ground truth, one row for each
frame, NaN if there is no box:

    success plot  share of frames whose overlap exceeds each of 21 thresholds 0, 0.05 ... 1; its mean is the AUC
    success       its value at 0.5
    precision     share of frames whose centre is at most 20 pixels off
    normalised precision  mean of that share over 51 thresholds 0 ... 0.5, distances as parts of the object's size
    lost          whether fewer than half of the frames in the last quarter have an overlap above 0.5

Frames without the object do not count; frames in which the tracker reports no
box count as missed. The values agree with the got10k toolkit. Whether the tracker
reports absence when the object is absent, and only then, is counted in `Absence`;
the measures of VOT's long-term challenge judge the boxes as well: see `long_term`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from catstream.base.arrays import Bool, Float64

#: Thresholds of the success plot (overlap) and of the precision plot (pixels).
OVERLAPS = np.linspace(0, 1, 21)
PIXELS = np.arange(51)
_SHARES = np.linspace(0, 0.5, 51)


@dataclass(frozen=True, slots=True)
class LongTerm:
    """Precision and recall of VOT-LT at the confidence where their F-score is highest."""

    precision: float
    recall: float
    f_score: float


@dataclass(frozen=True, slots=True)
class Absence:
    """Numbers of frames: without the object, of these without a reported box; with the object, of these without one."""

    absent: int
    noticed: int
    present: int
    false: int


@dataclass(frozen=True, slots=True)
class Score:
    """The measures of one run, from 0 to 1, and its counts; `long_term` is None if the object is never absent."""

    auc: float
    success: float
    precision: float
    normalised_precision: float
    lost: bool  # see `is_lost`
    absence: Absence
    long_term: LongTerm | None


def overlaps(boxes: Float64, truth: Float64) -> Float64:
    """Return the intersection over union of each pair of rows, float64 (frames, 4) both; 0 if either is NaN.

    >>> overlaps(np.array([[0., 0, 10, 10]]), np.array([[5., 0, 10, 10]]))
    array([0.33333333])
    """
    low = np.maximum(boxes[:, :2], truth[:, :2])
    high = np.minimum(boxes[:, :2] + boxes[:, 2:], truth[:, :2] + truth[:, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=1)
    union = np.prod(boxes[:, 2:], axis=1) + np.prod(truth[:, 2:], axis=1) - shared
    ratios = np.divide(shared, union, out=np.zeros(len(boxes)), where=union > 0)
    shares: Float64 = np.minimum(np.nan_to_num(ratios), 1.0)  # rounding may exceed 1
    return shares


def distances(boxes: Float64, truth: Float64, *, normalised: bool = False) -> Float64:
    """Return the distances between the centres in pixels; infinite if either box is NaN.

    normalised : divide each coordinate by the width or height of the ground truth box
    """
    offsets = (boxes[:, :2] + boxes[:, 2:] / 2) - (truth[:, :2] + truth[:, 2:] / 2)
    if normalised:
        offsets = offsets / np.maximum(truth[:, 2:], 1)
    return np.nan_to_num(np.hypot(offsets[:, 0], offsets[:, 1]), nan=np.inf)


def success_plot(boxes: Float64, truth: Float64) -> Float64:
    """Return the share of frames with the object whose overlap exceeds each of `OVERLAPS`, float64 (21,)."""
    shares: Float64 = (overlaps(boxes, truth)[_present(truth), None] > OVERLAPS).mean(axis=0)
    return shares


def is_lost(boxes: Float64, truth: Float64) -> bool:
    """Return whether fewer than half of the frames with the object in the last quarter have an overlap above 0.5."""
    last = slice(-math.ceil(len(truth) / 4), None)
    followed = overlaps(boxes[last], truth[last])[_present(truth[last])] > 0.5
    return bool(len(followed)) and bool(followed.mean() < 0.5)


def count_absence(boxes: Float64, truth: Float64) -> Absence:
    """Count the frames without and with the object, and those of each without a reported box."""
    present, reported = _present(truth), _present(boxes)
    counts = (~present, ~present & ~reported, present, present & ~reported)
    return Absence(*(int(frames.sum()) for frames in counts))


def precision_plot(boxes: Float64, truth: Float64) -> Float64:
    """Return the share of frames with the object whose centre error is at most each of `PIXELS`, float64 (51,)."""
    shares: Float64 = (distances(boxes, truth)[_present(truth), None] <= PIXELS).mean(axis=0)
    return shares


def long_term(boxes: Float64, truth: Float64, confidence: Float64) -> LongTerm:
    """Return precision, recall and F-score of VOT-LT (Lukezic et al. 2020).

    A box counts as reported if its confidence reaches a threshold. Precision is the mean overlap over the reported
    boxes (0 if the object is absent), recall the mean overlap over the frames with the object. The threshold with the
    best F-score is used; the confidence, float64 (frames,), may be in any range, and NaN is lower than any number.
    """
    answered = np.flatnonzero(_present(boxes))
    answered = answered[np.argsort(-np.nan_to_num(confidence[answered], nan=-np.inf), kind="stable")]
    if not len(answered):
        return LongTerm(0.0, 0.0, 0.0)
    shared = np.cumsum(overlaps(boxes, truth)[answered])
    confidences = confidence[answered]
    ends = np.append(confidences[1:] != confidences[:-1], True)  # rows of equal confidence are reported together
    precision = (shared / np.arange(1, len(answered) + 1))[ends]
    recall = (shared / _present(truth).sum())[ends]
    f_score = 2 * precision * recall / np.maximum(precision + recall, np.finfo(float).tiny)
    best = int(f_score.argmax())
    return LongTerm(float(precision[best]), float(recall[best]), float(f_score[best]))


def score(boxes: Float64, truth: Float64, confidence: Float64 | None = None) -> Score:
    """Return all measures of one run.

    boxes, truth : float64 (frames, 4), x, y, w, h in pixels, NaN if there is no box
    confidence : float64 (frames,), or None for a tracker without a confidence
    """
    present = _present(truth)
    success = success_plot(boxes, truth)
    off = distances(boxes, truth, normalised=True)[present]
    return Score(
        auc=float(success.mean()),
        success=float(success[10]),
        precision=float(precision_plot(boxes, truth)[20]),
        normalised_precision=float((off[:, None] <= _SHARES).mean()),
        lost=is_lost(boxes, truth),
        absence=count_absence(boxes, truth),
        long_term=None
        if present.all()
        else long_term(boxes, truth, np.ones(len(boxes)) if confidence is None else confidence),
    )


def _present(boxes: Float64) -> Bool:
    present: Bool = np.all(np.isfinite(boxes), axis=1)
    return present
