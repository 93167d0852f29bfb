"""Fusion of the passes of a stretch: one box for each frame, and the probability that it is right.

Each pass votes with a weight: it falls linearly from 1 at its own keyframe to 0 at the other one, and is four times as
high if the pass arrives at the box of the other keyframe, which is evidence that it did not lose the object before. The
box with the highest weighted sum of IoU wins, and is averaged with those that overlap it. The probability is a logistic
regression of two features: the share of votes for the winner, and its lowest IoU with the passes of the other direction
in the frames around. The second feature is 0 where only one direction was tracked, and where both directions miss the
object although it is absent at neither keyframe: then, both have mostly lost it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from catstream.annotation.passes import Keyframes, Pass, iou
from catstream.base.arrays import Bool, Float64

_ARRIVAL_WEIGHT = 4.0
_SAME = 0.5  #: IoU of two boxes that count as the same

#: Weights of the logistic regression: bias, then the features in `fuse`. They were fitted on 29 sequences with
#: one to four boxes, each sequence with the same weight.
_LOGISTIC = np.array([-4.4, 6.3, 3.8])
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
    ordered = [_in_order(one, count) for one in passes]
    boxes, scores = (np.stack(values) for values in zip(*ordered, strict=True))
    arrived = np.array([_arrives(one, keyframes) for one in passes])
    forward = np.array([one.is_forward for one in passes])
    way = np.arange(1, count + 1) / (count + 1)
    weights = np.where(forward[:, None], 1 - way, way) * np.where(arrived, _ARRIVAL_WEIGHT, 1.0)[:, None]
    shared = iou(boxes[:, None], boxes[None])  # (passes, passes, frames)
    votes = (shared * weights).sum(axis=1)
    best, frames = votes.argmax(axis=0), np.arange(count)
    agreement = shared[best, :, frames].T  # of the winner with each pass, (passes, frames)
    merged = _averaged(boxes, np.where(agreement > _SAME, weights, 0.0), best)
    opposite = np.where(forward[:, None] != forward[best], agreement, 0.0).max(axis=0)
    if not any(end in keyframes and keyframes[end] is None for end in (start - 1, stop)):
        opposite[np.isnan(merged[:, 0])] = 0.0
    around = np.lib.stride_tricks.sliding_window_view(np.pad(opposite, _AROUND, "edge"), 2 * _AROUND + 1).min(axis=1)
    features = np.column_stack([votes.max(axis=0) / weights.sum(axis=0), around])
    probabilities = 1 / (1 + np.exp(-_LOGISTIC[0] - features @ _LOGISTIC[1:]))
    return merged, probabilities, scores[best, frames]


def _in_order(one: Pass, count: int) -> tuple[Float64, Float64]:
    """Boxes and scores of a pass in the order of the video, without a keyframe at its end."""
    boxes, scores = one.boxes[:count], one.scores[:count]
    return (boxes, scores) if one.is_forward else (boxes[::-1], scores[::-1])


def _arrives(one: Pass, keyframes: Keyframes) -> bool:
    """Return True if a pass ends near the box of the keyframe at its end, or without a box if the object is absent."""
    return one.stop in keyframes and one.is_near(one.stop, keyframes[one.stop])


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
