"""Measures of one-pass evaluation, by the definitions of the public benchmarks.

They are computed from the boxes of a run and the ground truth, one row for each
frame, NaN without a box:

    success plot  share of frames whose overlap exceeds each of 21 thresholds 0, 0.05 ... 1; its mean is the AUC
    success       its value at 0.5
    precision     share of frames whose centre is at most 20 pixels off
    normalised precision  mean share over 51 thresholds 0 ... 0.5, with distances relative to the object's size

Frames without the object are ignored; frames without a reported box count as
missed. The values agree with the got10k toolkit. Correct and false reports of
absence are counted separately.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from catstream.base.arrays import Bool, Float64

#: Thresholds of the success plot (overlap) and of the precision plot (pixels).
OVERLAPS = np.linspace(0, 1, 21)
PIXELS = np.arange(51)
_SHARES = np.linspace(0, 0.5, 51)


@dataclass(frozen=True, slots=True)
class Score:
    """The measures of one run, from 0 to 1, and numbers of frames.

    absent, noticed  frames without the object, and the number of them without a reported box
    present, false   frames with the object, and the number of them without a reported box
    """

    auc: float
    success: float
    precision: float
    normalised_precision: float
    absent: int
    noticed: int
    present: int
    false: int


def present(boxes: Float64) -> Bool:
    """Return True for each row with a box, bool (frames,); a row with NaN has no box."""
    return np.asarray(np.isfinite(boxes).all(axis=1))


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
    return np.asarray(np.minimum(np.nan_to_num(ratios), 1.0))  # rounding may exceed 1


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
    return np.asarray((overlaps(boxes, truth)[present(truth), None] > OVERLAPS).mean(axis=0))


def precision_plot(boxes: Float64, truth: Float64) -> Float64:
    """Return the share of frames with the object whose centre error is at most each of `PIXELS`, float64 (51,)."""
    return np.asarray((distances(boxes, truth)[present(truth), None] <= PIXELS).mean(axis=0))


def score(boxes: Float64, truth: Float64) -> Score:
    """Return all measures of one run.

    boxes, truth : float64 (frames, 4), x, y, w, h in pixels, NaN without a box
    """
    is_present, is_reported = present(truth), present(boxes)
    success = success_plot(boxes, truth)
    errors = distances(boxes, truth, normalised=True)[is_present]
    return Score(
        auc=float(success.mean()),
        success=float(success[10]),
        precision=float(precision_plot(boxes, truth)[20]),
        normalised_precision=float((errors[:, None] <= _SHARES).mean()),
        absent=int((~is_present).sum()),
        noticed=int((~is_present & ~is_reported).sum()),
        present=int(is_present.sum()),
        false=int((is_present & ~is_reported).sum()),
    )
