"""Fusion of the passes of a stretch: one box for each frame, and the probability that it is right.

Each pass votes with a weight, which falls linearly from 1 at its own keyframe to 0 at the other one. A pass is cut into
pieces between frames whose boxes do not overlap: it has lost the object, or found another one. If the pass arrives at
the box of the other keyframe, the last piece has held the object, and has four times the weight. Other pieces that do
not begin at the pass's own keyframe have half of it.

The box with the highest weighted sum of IoU wins, and is averaged with those that overlap it. The probability is a
logistic regression of two features: the share of the weights of these boxes, and the winner's lowest IoU with the
passes of the other direction in the frames around. The second feature is 0 where both directions miss the object
although it is absent at neither keyframe: then, both have mostly lost it. Where only one direction was tracked, the
probability depends on the score, and never suffices to check a frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from catstream.base.arrays import Bool, Float64
from catstream.offline.passes import Keyframes, Pass, iou, row_of

_ARRIVAL_WEIGHT = 4.0
_APART_WEIGHT = 0.5  #: of a piece that is connected to neither keyframe
_SAME = 0.5  #: IoU of two boxes that count as the same

#: Weights of the logistic regressions: bias, then the features in `fuse`. They were fitted on 29 sequences with one to
#: four boxes, each sequence with the same weight.
_BOTH_DIRECTIONS = np.array([-2.8, 4.0, 3.8])
_ONE_DIRECTION = np.array([-2.75, 5.5])
_AROUND = 5  #: frames before and after a frame, whose agreement counts as well


def fuse(passes: Sequence[Pass], start: int, stop: int, keyframes: Keyframes) -> tuple[Float64, Float64, Float64]:
    """Fuse passes, or their parts, over the frames between two keyframes, or a keyframe and an end of the video.

    start, stop : first of these frames, and the one after the last

    Returns
    -------
    boxes : float64 (frames, 4), NaN where the object is absent
    probabilities : float64 (frames,), of an IoU above 0.5 with the true box, or of a right absence
    scores : float64 (frames,), of the pass with the winning box
    """
    count = stop - start
    if not passes:
        return np.full((count, 4), np.nan), np.zeros(count), np.zeros(count)
    ordered = [_in_order(one, count, keyframes) for one in passes]
    boxes, scores, weights = (np.stack(values) for values in zip(*ordered, strict=True))
    forward = np.array([one.is_forward for one in passes])
    way = np.arange(1, count + 1) / (count + 1)
    weights = weights * np.where(forward[:, None], 1 - way, way)
    shared = iou(boxes[:, None], boxes[None])  # (passes, passes, frames)
    votes = (shared * weights).sum(axis=1)
    best, frames = votes.argmax(axis=0), np.arange(count)
    agreement = shared[best, :, frames].T  # of the winner with each pass, (passes, frames)
    agreeing = np.where(agreement > _SAME, weights, 0.0)
    merged = _averaged(boxes, agreeing, best)
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


def _in_order(one: Pass, count: int, keyframes: Keyframes) -> tuple[Float64, Float64, Float64]:
    """Boxes, scores and weights of a pass in the order of the video, without a keyframe at its end."""
    before = np.vstack([row_of(keyframes[one.start]), one.boxes[:-1]])
    piece = np.cumsum(iou(before, one.boxes) == 0)
    weights = np.where(piece == 0, 1.0, _APART_WEIGHT)
    if one.stop in keyframes and one.is_near(one.stop, keyframes[one.stop]):
        weights[piece == piece[-1]] = _ARRIVAL_WEIGHT
    order = slice(None, None, 1 if one.is_forward else -1)
    return one.boxes[:count][order], one.scores[:count][order], weights[:count][order]


def _averaged(boxes: Float64, weights: Float64, best: np.ndarray) -> Float64:
    """The weighted mean of boxes (passes, frames, 4) of each frame; NaN where the winner has no box."""
    frames = np.arange(boxes.shape[1])
    present: Bool = ~np.isnan(boxes[..., 0])
    weights = np.where(present, weights, 0.0)[..., None]
    total = weights.sum(axis=0)
    corners = np.nan_to_num(boxes)
    mean = (corners * weights).sum(axis=0) / np.where(total, total, 1.0)
    merged: Float64 = np.where(present[best, frames][:, None], mean, np.nan)
    return merged
