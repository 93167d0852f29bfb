"""Assigns windows to objects: no two objects of a frame claim the same place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from catstream.box import Box
from catstream.detection.search import Detection
from catstream.messages import DetectorState

__all__ = ["assigned"]

_SAME_PLACE = 0.5  # above this overlap, two boxes are at the same place
_APART = 0.2  # up to this overlap of their first boxes, two objects are apart: they cannot be at the same place


def assigned(
    found: Mapping[str, Detection], states: Mapping[str, DetectorState], context: float
) -> dict[str, Detection]:
    """Give each place to one object, so that the sum of the scores is the highest.

    An object that loses its place takes the best other window near it; its score is 0 if there is none.

    Parameters
    ----------
    found : detection of each object of a frame, by name
    states : detector state of each object; objects whose first boxes overlapped may stay at the same place
    context : setting `search.context`, by which a window is larger than the object's box

    Returns
    -------
    the detection of each object; the same one if no other object claims its place
    """
    result = dict(found)
    boxes = {name: detection.window.box(context) for name, detection in found.items()}
    firsts = {name: (state.first_frame, _first_box(state, context)) for name, state in states.items()}
    for names in _conflicts(boxes, firsts):
        others = {
            name: _beside(found[name], [boxes[each] for each in names if each != name], context) for name in names
        }
        keeps = max(names, key=lambda name: found[name].score - others[name].score)
        result |= {name: others[name] for name in names if name != keeps}
    return result


def _conflicts(boxes: Mapping[str, Box], firsts: Mapping[str, tuple[int, Box]]) -> list[list[str]]:
    """The groups of two or more objects that are at the same place, and were apart when they began."""

    def conflict(one: str, other: str) -> bool:
        if boxes[one].overlap(boxes[other]) <= _SAME_PLACE:
            return False
        (frame, box), (other_frame, other_box) = firsts[one], firsts[other]
        return frame != other_frame or box.overlap(other_box) <= _APART

    groups: list[list[str]] = []
    for name in boxes:
        group = next((group for group in groups if any(conflict(name, other) for other in group)), None)
        if group is None:
            groups.append([name])
        else:
            group.append(name)
    return [group for group in groups if len(group) > 1]


def _beside(found: Detection, claimed: list[Box], context: float) -> Detection:
    """The best window near a detection that is not at a claimed place."""
    if found.around is not None:
        scores = found.around.scores.copy()
        for row, column in np.ndindex(scores.shape):
            box = found.around.window(row, column).box(context)
            if any(box.overlap(each) > _SAME_PLACE for each in claimed):
                scores[row, column] = -np.inf
        row, column = map(int, np.unravel_index(scores.argmax(), scores.shape))
        if scores[row, column] > 0:
            return Detection(float(scores[row, column]), found.around.window(row, column), found.around)
    return replace(found, score=0.0, redetected=False)


def _first_box(state: DetectorState, context: float) -> Box:
    return (state.first_window or state.window).box(context)
