"""Fusion of the passes of a stretch: one box for each frame, and the probability that it is correct.

Each pass votes with a weight, which decreases linearly from 1 at its own keyframe to 0 at the other one. A pass is
split where successive boxes do not overlap: it has lost the object, or jumped to another one. If the pass arrives at
the box of the other keyframe, its last piece has tracked the object, and has four times the weight. Other pieces that
do not begin at the pass's own keyframe have half the weight.

The box with the highest weighted sum of IoU wins, and is averaged with the boxes that overlap it. The probability is a
logistic regression of two features: the total weight of these boxes relative to all, and the winner's minimum IoU with
the passes of the other direction in neighbouring frames. The second feature is 0 if both directions report absence, but
the object is present at both keyframes: usually both have lost it. If only one direction was tracked, the probability
depends on the score, and is always too low for a checked frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from catstream.base.arrays import Bool, Float64
from catstream.offline.passes import Keyframes, Pass, iou, row_of

_ARRIVAL_WEIGHT = 4.0
_APART_WEIGHT = 0.5  #: weight of a piece that is connected to neither keyframe
_SAME = 0.5  #: IoU above which two boxes agree

#: Weights of the logistic regressions: bias, then the features in `fuse`. They were fitted on 29 sequences with one to
#: four boxes, each sequence with equal weight.
_BOTH_DIRECTIONS = np.array([-2.8, 4.0, 3.8])
_ONE_DIRECTION = np.array([-2.75, 5.5])
_AROUND = 5  #: number of neighbouring frames on each side for the second feature


def fuse(passes: Sequence[Pass], start: int, stop: int, keyframes: Keyframes) -> tuple[Float64, Float64, Float64]:
    """Fuse passes, or their parts, over the frames between two keyframes, or a keyframe and an end of the video.

    start, stop : the first frame, and the frame after the last one

    Returns
    -------
    boxes : float64 (frames, 4), NaN where the object is absent
    probabilities : float64 (frames,), of an IoU above 0.5 with the true box, or of a correct absence
    scores : float64 (frames,), of the pass with the winning box
    """
    count = stop - start
    if not passes:
        return np.full((count, 4), np.nan), np.zeros(count), np.zeros(count)
    # Step 1: the weight of each pass in each frame.
    ordered = [_in_order(item, count, keyframes) for item in passes]
    boxes, scores, weights = (np.stack(values) for values in zip(*ordered, strict=True))
    forward = np.array([item.is_forward for item in passes])
    progress = np.arange(1, count + 1) / (count + 1)
    weights = weights * np.where(forward[:, None], 1 - progress, progress)
    # Step 2: the winning box, averaged with the boxes that agree.
    overlap = iou(boxes[:, None], boxes[None])  # (passes, passes, frames)
    votes = (overlap * weights).sum(axis=1)
    best, frames = votes.argmax(axis=0), np.arange(count)
    agreement = overlap[best, :, frames].T  # of the winner with each pass, (passes, frames)
    agreeing = np.where(agreement > _SAME, weights, 0.0)
    merged = _averaged(boxes, agreeing, best)
    # Step 3: the features and the probability.
    opposite = np.where(forward[:, None] != forward[best], agreement, 0.0).max(axis=0)
    if not any(end in keyframes and keyframes[end] is None for end in (start - 1, stop)):
        opposite[np.isnan(merged[:, 0])] = 0.0
    around = np.lib.stride_tricks.sliding_window_view(np.pad(opposite, _AROUND, "edge"), 2 * _AROUND + 1).min(axis=1)
    if forward.all() or not forward.any():
        logits = np.column_stack([np.ones(count), scores[best, frames].clip(max=1.0)]) @ _ONE_DIRECTION
    else:
        shares = agreeing.sum(axis=0) / weights.sum(axis=0)
        logits = np.column_stack([np.ones(count), shares, around]) @ _BOTH_DIRECTIONS
    probabilities = 1 / (1 + np.exp(-logits))
    return merged, probabilities, scores[best, frames]


def _in_order(item: Pass, count: int, keyframes: Keyframes) -> tuple[Float64, Float64, Float64]:
    """Boxes, scores and weights of a pass in the order of the video, without a keyframe at its end."""
    previous = np.vstack([row_of(keyframes[item.start]), item.boxes[:-1]])
    piece = np.cumsum(iou(previous, item.boxes) == 0)
    weights = np.where(piece == 0, 1.0, _APART_WEIGHT)
    if item.stop in keyframes and item.is_near(item.stop, keyframes[item.stop]):
        weights[piece == piece[-1]] = _ARRIVAL_WEIGHT
    order = slice(None, None, 1 if item.is_forward else -1)
    return item.boxes[:count][order], item.scores[:count][order], weights[:count][order]


def _averaged(boxes: Float64, weights: Float64, best: np.ndarray) -> Float64:
    """The weighted mean over passes of boxes (passes, frames, 4); NaN where the winner has no box."""
    frames = np.arange(boxes.shape[1])
    present: Bool = ~np.isnan(boxes[..., 0])
    weights = np.where(present, weights, 0.0)[..., None]
    total = weights.sum(axis=0)
    corners = np.nan_to_num(boxes)
    mean = (corners * weights).sum(axis=0) / np.where(total, total, 1.0)
    merged: Float64 = np.where(present[best, frames][:, None], mean, np.nan)
    return merged
