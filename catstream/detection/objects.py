"""The detectors of all objects of a stream: one pyramid and one message of features a frame, a track for each object.

No two objects of a frame are at the same position: see `assign`.
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
from catstream.features.descriptor import descriptor_of, digest_of
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import DetectorState, Features, Model, Track, Tracks

_SAME_POSITION = 0.5  # IoU above which two boxes are at the same position
_INITIAL_OVERLAP = 0.2  # IoU of their initial boxes above which two objects may be at the same position
_UNTRUSTED_OVERLAP = 0.2  # IoU above which the box of an object that is not trusted may be a part of the other


class Detectors:
    """Tracks the objects of one stream, with a detector for each, by name in the order in which they began.

    For a frame, `begin` or `correct` the objects whose boxes are known, and `seek` the objects of saved models; then
    call `step`. All of them take the `pyramid` of the frame.

    SettingsError or MissingExtraError if the network of the settings cannot be used, see `descriptor_of`. If `network`
    is not empty, the network must have this digest.
    """

    def __init__(self, settings: Settings, network: str = "") -> None:
        if settings.training.bootstrap == "scm":  # two seconds, for sklearn: before there is a frame
            import catstream.paper.scm  # noqa: F401
        self.settings, self.descriptor = settings, descriptor_of(settings, network)
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
        return Detector(self.settings, check_name(name), self.descriptor)

    @property
    def network(self) -> str:
        """Digest of the network, empty if there is none."""
        return digest_of(self.descriptor)

    def pyramid(self, image: np.ndarray) -> Pyramid:
        """The pyramid of a frame, uint8 (h, w, 3) BGR."""
        return Pyramid(image, self.descriptor)

    def begin(self, name: str, frame: Pyramid, box: Box, time: float = 0.0, later: Iterable[Pyramid] = ()) -> Result:
        """Start an object with its box in the next frame; another one of this name is forgotten.

        If the box is of a past frame, the object is searched in the `later` frames, of which the last one is the next
        frame. Nothing changes after a BoxError of `Detector.init` or an ObjectError of `add`.
        """
        detector = self.detectors.get(name) or self._new_detector(name)
        with errors_about(name):
            result = detector.init(frame, self.seq + 1, time, box)
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

        Nothing changes after a ProtocolError of `Detector.seek` or an ObjectError of `add`.
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
        detections = {name: detector.search(frame, self.seq) for name, detector in detectors.items()}
        states = {name: detector.state for name, detector in detectors.items() if detector.state is not None}
        detections = assign(detections, states, self.settings.search.context)
        for name, detector in detectors.items():
            results[name] = detector.update(detections[name], frame, self.seq, time)
        names = [*self.detectors, *(name for name in results if name not in self.detectors)]
        tracks: dict[str, Track] = {name: results[name][0] for name in names}
        objects = {name: results[name][1] for name in names}
        return Tracks(self.seq - 1, tracks), Features(self.seq - 1, time, objects, self.network)

    def forget(self, name: str) -> None:
        """Stop tracking an object; ObjectError if there is none of this name."""
        if name not in self.detectors:
            raise ObjectError(f"there is no object {name!r}: the objects are {listed(self.detectors)}")
        del self.detectors[name]

    def adopt(self, model: Model) -> None:
        """Use a model for its object from now on, see `Detector.adopt`; that of a forgotten object is dropped."""
        if (detector := self.detectors.get(model.object)) is not None:
            detector.adopt(model)


def assign(
    detections: Mapping[str, Detection], states: Mapping[str, DetectorState], context: float
) -> dict[str, Detection]:
    """Resolve conflicts: give a position to one object, to the one whose score would fall most without it.

    An object that loses its position gets the best other window near it; its score is 0 if there is none. One that is
    not trusted, because it was last detected elsewhere, also loses a position of which a smaller part is another
    object's: most likely it is lost, and a part of the other one looks similar. Objects whose initial boxes overlapped
    may be at the same position, and an object that is still sought occupies none. Without a conflict, a detection is
    unchanged. The windows are `context` times as large as the boxes of the objects.
    """
    initial = {
        name: (state.first_frame, state.first_window.box(context))
        for name, state in states.items()
        if state.first_window is not None
    }
    boxes = {name: detections[name].window.box(context) for name in initial}
    rivals = {
        name: [other for other in initial if other != name and _are_exclusive(initial[name], initial[other])]
        for name in initial
    }

    limits = {
        name: _SAME_POSITION if states[name].trusted and not detections[name].redetected else _UNTRUSTED_OVERLAP
        for name in initial
    }

    def rival_boxes(name: str, positions: Mapping[str, Box]) -> list[Box]:
        return [positions[other] for other in rivals[name] if other in positions]

    def in_conflict(name: str, positions: Mapping[str, Box]) -> bool:
        return any(boxes[name].overlap(box) > limits[name] for box in rival_boxes(name, positions))

    conflicts = [name for name in initial if in_conflict(name, boxes)]
    alternatives = {
        name: _best_elsewhere(detections[name], rival_boxes(name, boxes), context, limits[name]) for name in conflicts
    }
    assigned = {name: box for name, box in boxes.items() if name not in conflicts}
    result = dict(detections)
    for name in sorted(conflicts, key=lambda name: detections[name].score - alternatives[name].score, reverse=True):
        if in_conflict(name, assigned):
            # Neither at an assigned position, nor at one that a later object may be assigned.
            result[name] = _best_elsewhere(detections[name], rival_boxes(name, boxes | assigned), context, limits[name])
        if result[name].score > 0:
            assigned[name] = result[name].window.box(context)
        boxes.pop(name)
    return result


def _are_exclusive(one: tuple[int, Box], other: tuple[int, Box]) -> bool:
    """Return True if two objects cannot be at the same position, by their first frames and initial boxes."""
    (frame, box), (other_frame, other_box) = one, other
    return frame != other_frame or box.overlap(other_box) <= _INITIAL_OVERLAP


def _best_elsewhere(detection: Detection, occupied: list[Box], context: float, limit: float) -> Detection:
    """The best window near a detection that is at none of the occupied positions."""
    if detection.around is not None:
        scores = detection.around.scores.copy()
        for row, column in np.ndindex(scores.shape):
            box = detection.around.window(row, column).box(context)
            if any(box.overlap(other) > limit for other in occupied):
                scores[row, column] = -np.inf
        row, column = map(int, np.unravel_index(scores.argmax(), scores.shape))
        if scores[row, column] > 0:
            # Elsewhere in the frame, it is redetected there too: its object is not trusted.
            return replace(detection, score=float(scores[row, column]), window=detection.around.window(row, column))
    return replace(detection, score=0.0, redetected=False)
