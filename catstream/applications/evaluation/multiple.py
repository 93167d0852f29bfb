"""Measures for several objects: MOTA, IDF1 and HOTA.

MOTA and the identity switches are those of CLEAR MOT (Bernardin and Stiefelhagen 2008), IDF1 is that of Ristani et al.
(2016), HOTA that of Luiten et al. (2021). A box counts as found in the first two if it overlaps the truth by half. The
libraries that have them bring pandas, or cannot be installed beside the headless OpenCV.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from catstream.box import Box

#: The box of each object in one frame by name; None while it is absent.
Boxes = Mapping[str, Box | None]

_OVERLAP = 0.5  # with the truth, from which a box counts as found in MOTA and IDF1
_ALPHAS = np.arange(0.05, 0.99, 0.05)  # the overlaps over which HOTA is averaged


#: Objects of the truth, objects that were found, and the overlap of each pair, of one frame.
_Frame = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, slots=True)
class MultipleScores:
    """Accuracy of the tracks of several objects; all shares are 1 at best.

    mota      1 - (missed + false boxes + identity switches) / boxes of the truth
    idf1      F1 score of the boxes that have the right identity
    hota      higher order tracking accuracy, the mean over the overlaps 0.05, 0.1 ... 0.95
    switches  how often an object of the truth is followed under another name than before
    """

    mota: float
    idf1: float
    hota: float
    switches: int


def score_multiple(truth: Sequence[Boxes], found: Sequence[Boxes]) -> MultipleScores:
    """Compare the boxes that were found with the truth, frame by frame.

    The names need not agree: an object of the truth is compared with the object that overlaps it.

    >>> frames = [{"anna": Box(0, 0, 10, 10), "ben": Box(50, 0, 10, 10)}] * 4
    >>> scores = score_multiple(frames, [{"x": boxes["anna"]} for boxes in frames])
    >>> round(scores.mota, 2), round(scores.idf1, 2), round(scores.hota, 2), scores.switches
    (0.5, 0.67, 0.71, 0)
    """
    frames, totals = _numbered(truth, found)
    true, reported = (sum(len(each[part]) for each in frames) for part in (0, 1))
    right, switches = _clear_mot(frames)
    mota = 1 - (true - right + reported - right + switches) / max(true, 1)
    return MultipleScores(mota, _idf1(frames, totals), _hota(frames, totals), switches)


def _clear_mot(frames: Sequence[_Frame]) -> tuple[int, int]:
    """Return how many boxes were found, and how often an object was found as another one than before.

    An object stays with the one that it was found as last, as long as both overlap enough; the others are assigned so
    that most are found, with the largest overlaps.
    """
    from scipy.optimize import linear_sum_assignment

    last: dict[int, int] = {}
    right = switches = 0
    for rows, columns, overlaps in frames:
        names, others = rows.tolist(), columns.tolist()
        gain = np.where(overlaps >= _OVERLAP, len(rows) + overlaps, 0.0)
        for row, name in enumerate(names):
            column = others.index(last[name]) if last.get(name) in others else None
            if column is not None and (kept := gain[row, column]):
                gain[row], gain[:, column] = 0.0, 0.0
                gain[row, column] = kept
        for row, column in zip(*(places.tolist() for places in linear_sum_assignment(-gain)), strict=True):
            if gain[row, column]:
                right += 1
                switches += last.get(names[row], others[column]) != others[column]
                last[names[row]] = others[column]
    return right, switches


def _idf1(frames: Sequence[_Frame], totals: tuple[int, int]) -> float:
    """F1 score of the boxes, if each object of the truth is assigned to one that was found, for all frames."""
    from scipy.optimize import linear_sum_assignment

    together = np.zeros(totals)
    for rows, columns, overlaps in frames:
        together[np.ix_(rows, columns)] += overlaps >= _OVERLAP
    boxes = sum(len(rows) + len(columns) for rows, columns, _ in frames)
    return 2 * float(together[linear_sum_assignment(-together)].sum()) / max(boxes, 1)


def _hota(frames: Sequence[_Frame], totals: tuple[int, int]) -> float:
    """Higher order tracking accuracy: the mean over the overlaps of sqrt(detection accuracy * association accuracy)."""
    from scipy.optimize import linear_sum_assignment

    if not all(totals):
        return 0.0
    together, true_count, found_count = np.zeros(totals), np.zeros((totals[0], 1)), np.zeros((1, totals[1]))
    for rows, columns, overlaps in frames:
        union = overlaps.sum(axis=0) + overlaps.sum(axis=1, keepdims=True) - overlaps
        together[np.ix_(rows, columns)] += np.divide(overlaps, union, out=np.zeros_like(overlaps), where=union > 0)
        true_count[rows] += 1
        found_count[:, columns] += 1
    aligned = together / (true_count + found_count - together)
    matches = np.zeros((len(_ALPHAS), *together.shape))
    for rows, columns, overlaps in frames:
        chosen = linear_sum_assignment(-aligned[np.ix_(rows, columns)] * overlaps)
        for i, alpha in enumerate(_ALPHAS):
            enough = overlaps[chosen] >= alpha - np.finfo(float).eps
            matches[i, rows[chosen[0][enough]], columns[chosen[1][enough]]] += 1
    right = matches.sum(axis=(1, 2))
    detection = right / (true_count.sum() + found_count.sum() - right)
    jaccard = matches / (true_count + found_count - matches)
    association = (matches * jaccard).sum(axis=(1, 2)) / np.maximum(right, 1)
    return float(np.sqrt(detection * association).mean())


def _present(boxes: Boxes) -> dict[str, Box]:
    return {name: box for name, box in boxes.items() if box is not None}


def _numbered(truth: Sequence[Boxes], found: Sequence[Boxes]) -> tuple[list[_Frame], tuple[int, int]]:
    """The objects of each frame as numbers, with the overlaps of their boxes, and how many objects there are in all."""
    names = [sorted({name for boxes in each for name in _present(boxes)}) for each in (truth, found)]
    frames = []
    for pair in zip(truth, found, strict=True):
        boxes = [_present(each) for each in pair]
        rows, columns = (
            np.array([of.index(name) for name in each], int) for of, each in zip(names, boxes, strict=True)
        )
        overlaps = [[box.overlap(other) for other in boxes[1].values()] for box in boxes[0].values()]
        frames.append((rows, columns, np.array(overlaps, float).reshape(len(rows), len(columns))))
    return frames, (len(names[0]), len(names[1]))
