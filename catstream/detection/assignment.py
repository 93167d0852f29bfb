"""Assigns windows to objects: no two objects of a frame claim the same place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from catstream.box import Box
from catstream.detection.search import Detection
from catstream.messages.kinds import DetectorState

_SAME_PLACE = 0.5  # above this overlap, two boxes are at the same place
_SHARED = 0.2  # above this overlap of their first boxes, two objects may be at the same place


def assigned(
    found: Mapping[str, Detection], states: Mapping[str, DetectorState], context: float
) -> dict[str, Detection]:
    """Give each place to one object: first to the one whose score would fall most without it.

    An object that loses its place takes the best other window near it; its score is 0 if there is none.

    Parameters
    ----------
    found : detection of each object of a frame, by name
    states : detector state of each object; objects whose first boxes overlapped may stay at the same place, and one
        that is still sought claims none
    context : setting `search.context`, by which a window is larger than the object's box

    Returns
    -------
    the detection of each object; the same one if no other object claims its place
    """
    firsts = {
        name: (state.first_frame, state.first_window.box(context))
        for name, state in states.items()
        if state.first_window is not None
    }
    boxes = {name: found[name].window.box(context) for name in firsts}
    rivals = {
        name: [other for other in firsts if other != name and _apart(firsts[name], firsts[other])] for name in firsts
    }

    def claimed(name: str, places: Mapping[str, Box]) -> list[Box]:
        return [places[other] for other in rivals[name] if other in places]

    def taken(name: str, places: Mapping[str, Box]) -> bool:
        return any(boxes[name].overlap(box) > _SAME_PLACE for box in claimed(name, places))

    contested = [name for name in firsts if taken(name, boxes)]
    others = {name: _beside(found[name], claimed(name, boxes), context) for name in contested}
    given = {name: box for name, box in boxes.items() if name not in contested}
    result = dict(found)
    for name in sorted(contested, key=lambda name: found[name].score - others[name].score, reverse=True):
        if taken(name, given):
            # Beside what was given, and what the objects that come later may keep.
            result[name] = _beside(found[name], claimed(name, boxes | given), context)
        if result[name].score > 0:
            given[name] = result[name].window.box(context)
        boxes.pop(name)
    return result


def _apart(one: tuple[int, Box], other: tuple[int, Box]) -> bool:
    """Whether two objects cannot be at the same place, by their first frames and boxes."""
    (frame, box), (other_frame, other_box) = one, other
    return frame != other_frame or box.overlap(other_box) <= _SHARED


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
