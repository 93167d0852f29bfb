"""The detectors of all objects of a stream: one pyramid and one message of features a frame, a track for each object.

No two objects of a frame are at the same position, unless they are together: see `assign`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import replace

import numpy as np

from catstream.base.box import Box
from catstream.base.names import check_count, check_name, errors_about
from catstream.base.settings import Settings
from catstream.base.text import listed
from catstream.detection.detector import Detector, Result
from catstream.detection.search import Detection
from catstream.detection.similarity import Similarity
from catstream.errors import ObjectError
from catstream.features.pyramid import Pyramid
from catstream.wire.messages import DetectorState, Features, Model, Track, Tracks

_SAME_POSITION = 0.5  # IoU above which two boxes are at the same position
_PART = 1 / 3  # share of a box that is inside another one, above which the one is at a part of the other
_LEAD = 0.4  # difference of score with which an uncertain object displaces a certain one


class Detectors:
    """Tracks the objects of one stream, with a detector for each, by name in the order in which they began.

    For a frame, `begin` or `correct` the objects whose boxes are known, and `seek` the objects of saved models; then
    call `step`. All of them take the pyramid of the frame.
    """

    def __init__(self, settings: Settings) -> None:
        if settings.training.bootstrap == "scm":  # two seconds, for sklearn: before there is a frame
            import catstream.detection.scm  # noqa: F401
        self.settings, self.seq = settings, 0
        self.detectors: dict[str, Detector] = {}

    def add(self, name: str) -> Detector:
        """Return the detector of an object, a new one if there is none yet.

        ObjectError if the name is not valid, or there are too many objects.
        """
        if name not in self.detectors:
            self.detectors[name] = self._new_detector(name)
        return self.detectors[name]

    def _new_detector(self, name: str) -> Detector:
        check_count(len(self.detectors) + 1, self.settings.run.max_objects)
        return Detector(self.settings, check_name(name))

    def begin(self, name: str, frame: Pyramid, box: Box, time: float = 0.0, later: Iterable[Pyramid] = ()) -> Result:
        """Start an object with its box in the next frame; another one of this name is forgotten.

        If the box is of a past frame, the object is searched in the `later` frames, of which the last one is the next
        frame. Nothing changes after a BoxError of `Detector.init` or an ObjectError of `add`.
        """
        detector = self.detectors.get(name) or self._new_detector(name)
        with errors_about(name):
            box = Box(*map(float, box)).validated(*frame.size)
            # It is together with each object whose box is at a part of its own, or the other way round.
            together = {
                other: state.first_frame
                for other, one in self.detectors.items()
                if other != name and (state := one.state) is not None and state.level != "lost"
                if max(box.share_in(state.window.box()), state.window.box().share_in(box)) > _PART
            }
            result = detector.init(frame, self.seq + 1, time, box, together)
        self.detectors.pop(name, None)
        self.detectors[name] = detector  # the last one, even if another object had the name
        return self._catch_up(detector, result, time, later)

    def _catch_up(self, detector: Detector, result: Result, time: float, later: Iterable[Pyramid]) -> Result:
        """Track an object through later frames, and return its result in the last one, with the rows of the box."""
        track, features = result
        for frame in later:
            detection = detector.search(frame, self.seq + 1)
            track, latest = detector.update(detection, frame, self.seq + 1, time)
            features = replace(latest, training=features.training)
        return track, features

    def seek(self, name: str, model: Model, box: Box, similarity: Similarity) -> None:
        """Search for the object of a saved model from the next frame on; another one of this name is forgotten.

        Nothing changes after an ObjectError of `add`.
        """
        detector = self.detectors.get(name) or self._new_detector(name)
        detector.seek(model, box, similarity, self.seq)
        self.detectors.pop(name, None)
        self.detectors[name] = detector  # the last one, as in `begin`

    def begin_all(self, boxes: Mapping[str, Box], frame: Pyramid, time: float = 0.0) -> dict[str, Result]:
        """Start several objects with their boxes in the next frame, by name; if one box is an error, none of them."""
        trial = copy(self)
        trial.detectors = dict(self.detectors)
        for name in boxes.keys() & trial.detectors.keys():
            trial.detectors[name] = copy(trial.detectors[name])
        results = {name: trial.begin(name, frame, box, time) for name, box in boxes.items()}
        self.detectors = trial.detectors
        return results

    def correct(self, name: str, frame: Pyramid, box: Box, time: float = 0.0, later: Iterable[Pyramid] = ()) -> Result:
        """Continue an object at another box: see `Detector.correct`; the frames are as in `begin`."""
        detector = self.detectors[name]
        return self._catch_up(detector, detector.correct(frame, self.seq + 1, time, box), time, later)

    def step(
        self, frame: Pyramid, time: float = 0.0, results: Mapping[str, Result] | None = None
    ) -> tuple[Tracks, Features]:
        """Track the objects in the next frame; `results` has those of `begin` and `correct`, which are not searched."""
        self.seq += 1
        results = dict(results or {})
        detectors = {name: detector for name, detector in self.detectors.items() if name not in results}
        before = {name: detector.state for name, detector in self.detectors.items() if detector.state is not None}
        for name in detectors.keys() & before.keys():
            detectors[name].state = _without_separated(before[name], before)
        detections = {name: detector.search(frame, self.seq) for name, detector in detectors.items()}
        states = {name: detector.state for name, detector in detectors.items() if detector.state is not None}
        detections = assign(detections, states)
        for name, detector in detectors.items():
            results[name] = detector.update(detections[name], frame, self.seq, time)
        names = [*self.detectors, *(name for name in results if name not in self.detectors)]
        tracks: dict[str, Track] = {name: results[name][0] for name in names}
        objects = {name: results[name][1] for name in names}
        return Tracks(self.seq - 1, tracks), Features(self.seq - 1, time, objects)

    def forget(self, name: str) -> None:
        """Stop tracking an object; ObjectError if there is none of this name."""
        if name not in self.detectors:
            raise ObjectError(f"there is no object {name!r}: the objects are {listed(self.detectors)}")
        del self.detectors[name]

    def adopt(self, model: Model) -> None:
        """Use a model for its object from now on, see `Detector.adopt`; that of a forgotten object is dropped."""
        if (detector := self.detectors.get(model.object)) is not None:
            detector.adopt(model)


def assign(detections: Mapping[str, Detection], states: Mapping[str, DetectorState]) -> dict[str, Detection]:
    """Resolve conflicts: give a position to one object, to the one whose score would fall most without it.

    An object that loses its position gets the best other window near it; its score is 0 if there is none. Objects that
    are `together` may be at the same position, and an object that is still sought occupies none. Without a conflict, a
    detection is unchanged.

    An object is uncertain if it was not "confident" in the last frame, or is redetected. Most likely it is absent or
    occluded, and a part of another object resembles it. So it also loses a position of which more than a third is in
    the box of a certain object, or of one with a higher score; and a certain object loses its position to an uncertain
    one only if the score of that is clearly higher.
    """
    names = [name for name, state in states.items() if not state.is_sought]
    boxes = {name: detections[name].window.box() for name in names}
    scores = {name: detections[name].score for name in names}
    uncertain = {name for name in names if states[name].level != "confident" or detections[name].redetected}
    # Step 1: the others are certain, unless an uncertain object scores clearly higher at their position.
    certain = {
        name
        for name in set(names) - uncertain
        if not any(scores[name] < scores[other] - _LEAD and _conflict(boxes[name], boxes[other]) for other in uncertain)
    }
    # Step 2: an object gives way to the certain ones, and if it is not certain itself, to those that score higher.
    exclusive = {
        name: [other for other in names if other != name and not _are_together(states, name, other)] for name in names
    }
    rivals = {
        name: [
            other
            for other in exclusive[name]
            if other in certain or (name not in certain and scores[other] >= scores[name])
        ]
        for name in names
    }

    def in_conflict(name: str, positions: Mapping[str, Box]) -> bool:
        occupied = [positions[other] for other in rivals[name] if other in positions]
        return any(_conflict(boxes[name], box, name in uncertain) for box in occupied)

    def elsewhere(name: str, positions: Mapping[str, Box]) -> Detection:
        occupied = [positions[other] for other in exclusive[name] if other in positions]
        return _best_elsewhere(detections[name], occupied, name in uncertain)

    # Step 3: objects without a conflict keep their positions. Of the rest, the certain ones come first, then those
    # that would lose most; each keeps its position if that is free, or gets the best one near it.
    conflicts = [name for name in names if in_conflict(name, boxes)]
    loss = {name: scores[name] - elsewhere(name, boxes).score for name in conflicts}
    assigned = {name: box for name, box in boxes.items() if name not in conflicts}
    result = dict(detections)
    for name in sorted(conflicts, key=lambda name: (name in certain, loss[name]), reverse=True):
        taken = [assigned[other] for other in exclusive[name] if other in assigned]  # also by one with a lower score
        if in_conflict(name, assigned) or any(_conflict(boxes[name], box) for box in taken):
            # Neither at an assigned position, nor at one that a later object may be assigned.
            result[name] = elsewhere(name, boxes | assigned)
        if result[name].score > 0:
            assigned[name] = result[name].window.box()
        boxes.pop(name)
    return result


def _are_together(states: Mapping[str, DetectorState], name: str, other: str) -> bool:
    """Return True if the boxes of two objects overlap since the first frame of one of them."""
    first, second = states[name], states[other]
    return first.together.get(other) == second.first_frame or second.together.get(name) == first.first_frame


def _without_separated(state: DetectorState, states: Mapping[str, DetectorState]) -> DetectorState:
    """The state of an object without the objects that it was together with, and that are confidently apart by now."""
    if not state.together:
        return state
    box = state.window.box()
    together = {
        name: first
        for name, first in state.together.items()
        if name in states
        and (not state.level == states[name].level == "confident" or box.overlap(states[name].window.box()))
    }
    return replace(state, together=together)


def _conflict(box: Box, other: Box, uncertain: bool = False) -> bool:
    """Return True if a box is at the position of another one, or, if its object is uncertain, at a part of it."""
    return box.overlap(other) > _SAME_POSITION or (uncertain and box.share_in(other) > _PART)


def _best_elsewhere(detection: Detection, occupied: list[Box], uncertain: bool) -> Detection:
    """The best window near a detection that is at none of the occupied positions."""
    if (around := detection.around) is not None:
        for index in np.argsort(-around.scores, axis=None, kind="stable"):
            row, column = map(int, np.unravel_index(index, around.scores.shape))
            if (score := float(around.scores[row, column])) <= 0:
                break
            window = around.window(row, column)
            if not any(_conflict(window.box(), other, uncertain) for other in occupied):
                # Elsewhere in the frame, it is redetected there too: its object is not trusted.
                return replace(detection, score=score, window=window)
    return replace(detection, score=0.0, redetected=False)
