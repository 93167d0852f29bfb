"""The detectors of all objects of a stream: one pyramid and one message of features a frame, a track for each object.

No two objects of a frame are at the same position, unless they are together: see `assign`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import replace
from itertools import permutations

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
        if settings.training.bootstrap == "scm":  # sklearn takes two seconds: before the first frame
            import catstream.detection.scm  # noqa: F401
        self.settings = settings
        self.seq = 0
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
        """Start several objects with their boxes in the next frame, by name; no object starts if one box is invalid."""
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
        """Track the objects in the next frame; those with `results` of `begin` or `correct` are not searched."""
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
        names = dict.fromkeys([*self.detectors, *results])
        tracks: dict[str, Track] = {name: results[name][0] for name in names}
        objects = {name: results[name][1] for name in names}
        return Tracks(self.seq - 1, tracks), Features(self.seq - 1, time, objects)

    def forget(self, name: str) -> None:
        """Stop tracking an object; ObjectError if there is none of this name."""
        if name not in self.detectors:
            raise ObjectError(f"there is no object {name!r}: the objects are {listed(self.detectors)}")
        del self.detectors[name]

    def adopt(self, model: Model) -> None:
        """Use a model for its object from now on (see `Detector.adopt`), unless the object was forgotten."""
        if (detector := self.detectors.get(model.object)) is not None:
            detector.adopt(model)


class Claim:
    """A detection as the claim of its object to a position in the frame."""

    def __init__(self, name: str, detection: Detection, state: DetectorState) -> None:
        self.name = name
        self.state = state
        self.detection = detection
        self.box = detection.window.box()
        self.score = detection.score  # also after `assign` has moved the other two
        # Most likely, such an object is absent or occluded, and a part of another object resembles it.
        self.is_uncertain = state.level != "confident" or detection.redetected
        # False also for an object whose position an uncertain one claims with a clearly higher score.
        self.is_certain = not self.is_uncertain

    def excludes(self, other: Claim) -> bool:
        """Return True if another object may not be at the same position: they are not `together`."""
        one, two = self.state, other.state
        are_together = one.together.get(other.name) == two.first_frame or two.together.get(self.name) == one.first_frame
        return self is not other and not are_together

    def yields_to(self, other: Claim) -> bool:
        """Return True if another object, an uncertain one, has a clearly higher score at the same position."""
        return other.is_uncertain and self.score < other.score - _LEAD and _conflict(self.box, other.box)

    def overlaps(self, others: Iterable[Claim]) -> bool:
        """Return True if it is at the position of another object."""
        return any(self.excludes(other) and _conflict(self.box, other.box) for other in others)

    def conflicts(self, others: Iterable[Claim]) -> bool:
        """Return True if it conflicts with a certain object, or, unless it is certain, with one of a higher score."""
        return any(
            (other.is_certain or (not self.is_certain and other.score >= self.score))
            and self.excludes(other)
            and _conflict(self.box, other.box, self.is_uncertain)
            for other in others
        )

    def elsewhere(self, others: Iterable[Claim]) -> Detection:
        """Return the best window near the detection outside the positions of others; its score is 0 without one."""
        occupied = [other.box for other in others if self.excludes(other)]
        if (around := self.detection.around) is not None:
            for index in np.argsort(-around.scores, axis=None, kind="stable"):
                row, column = map(int, np.unravel_index(index, around.scores.shape))
                if (score := float(around.scores[row, column])) <= 0:
                    break
                window = around.window(row, column)
                if not any(_conflict(window.box(), other, self.is_uncertain) for other in occupied):
                    # A redetected object is redetected there as well, so it is not trusted.
                    return replace(self.detection, score=score, window=window)
        return replace(self.detection, score=0.0, redetected=False)


def assign(detections: Mapping[str, Detection], states: Mapping[str, DetectorState]) -> dict[str, Detection]:
    """Resolve conflicts: assign each contested position to the object whose score would fall most without it.

    An object that loses its position gets the best other window near it; its score is 0 if there is none. Objects that
    are `together` may be at the same position, and an object that is not yet detected occupies none. Without a
    conflict, a detection is unchanged.

    An object is uncertain if it was not "confident" in the last frame, or is redetected. It also loses a position of
    which more than a third is in the box of a certain object, or of an object with a higher score. A certain object
    loses its position to an uncertain one only if the score of the uncertain one is clearly higher.
    """
    claims = [Claim(name, detections[name], state) for name, state in states.items() if not state.is_searched]
    # Step 1: an object is not certain if an uncertain one scores clearly higher at its position.
    for claim, other in permutations(claims, 2):
        claim.is_certain &= not claim.yields_to(other)
    # Step 2: objects without a conflict keep their positions. Of the rest, the certain ones come first, then those that
    # would lose most.
    disputed = [claim for claim in claims if claim.conflicts(claims)]
    disputed.sort(key=lambda claim: (claim.is_certain, claim.score - claim.elsewhere(claims).score), reverse=True)
    # Step 3: an object keeps its position if it is free. Otherwise, it moves to the best window that no object has, or
    # claims later.
    pending = set(disputed)
    assigned = set(claims) - pending
    for claim in disputed:
        # An object of a lower score that had more to lose may be there.
        if claim.overlaps(assigned) or claim.conflicts(assigned):
            claim.detection = claim.elsewhere(assigned | pending)
            claim.box = claim.detection.window.box()
        pending.remove(claim)
        if claim.detection.score > 0:
            assigned.add(claim)
    return {**detections, **{claim.name: claim.detection for claim in claims}}


def _without_separated(state: DetectorState, states: Mapping[str, DetectorState]) -> DetectorState:
    """Return a state that is no longer `together` with objects from which it is confidently separated."""
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
