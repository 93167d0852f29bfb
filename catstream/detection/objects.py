"""The detectors of all objects of a stream: one pyramid and one message of features a frame, a track for each object.

No two objects of a frame claim the same place: `assigned`.
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
from catstream.base.threads import in_parallel
from catstream.detection.detector import Detector, Result
from catstream.detection.search import Detection
from catstream.detection.similarity import Similarity
from catstream.errors import ObjectError
from catstream.features.descriptor import descriptor_of, digest_of
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import DetectorState, Features, Model, Track, Tracks

_SAME_PLACE = 0.5  # above this overlap, two boxes are at the same place
_SHARED = 0.2  # above this overlap of their first boxes, two objects may be at the same place


class Detectors:
    """Follows the objects of one stream, each with a detector of its own, by name in the order in which they began.

    For a frame, `begin` or `correct` the objects whose box is given, and `seek` those of saved models; then `step`.
    Each takes the `pyramid` of the frame.

    SettingsError or MissingExtraError if the network of the settings cannot be used, see `descriptor_of`; `network` is
    the digest that it must have, if that is known.
    """

    def __init__(self, settings: Settings, network: str = "") -> None:
        if settings.teaching.bootstrap == "scm":  # two seconds, for sklearn: before there is a frame
            import catstream.paper.scm  # noqa: F401
        self.settings, self.descriptor = settings, descriptor_of(settings, network)
        self.seq = 0
        self.detectors: dict[str, Detector] = {}

    def add(self, name: str) -> Detector:
        """Return the detector of an object, a new one if there is none yet.

        ObjectError if the name is not valid, or there are too many objects.
        """
        if name not in self.detectors:
            self.detectors[name] = self._made(name)
        return self.detectors[name]

    def _made(self, name: str) -> Detector:
        """A new detector, for one more object."""
        check_count(len(self.detectors) + 1, self.settings.run.objects_most)
        return Detector(self.settings, check_name(name), self.descriptor)

    @property
    def network(self) -> str:
        """Digest of the network, empty if there is none."""
        return digest_of(self.descriptor)

    def pyramid(self, image: np.ndarray) -> Pyramid:
        """A frame, uint8 (h, w, 3) BGR, for the calls that take one."""
        return Pyramid(image, self.descriptor)

    def begin(self, name: str, frame: Pyramid, box: Box, time: float = 0.0, later: Iterable[Pyramid] = ()) -> Result:
        """Start an object with its box in the next frame; another one of this name is forgotten.

        The box may be of a frame in the past: then it is searched for in the `later` ones, of which the last is the
        next frame. Nothing changes after a BoxError, as of `Detector.init`, or an ObjectError, as of `add`.
        """
        detector = self.detectors.get(name) or self._made(name)
        with errors_about(name):
            result = detector.init(frame, self.seq + 1, time, box)
        self.detectors.pop(name, None)
        self.detectors[name] = detector  # the last one, also if another object had the name
        return self._caught_up(detector, result, time, later)

    def _caught_up(self, detector: Detector, result: Result, time: float, later: Iterable[Pyramid]) -> Result:
        """The result in the last of some frames, by a search of each; training rows are those of the box."""
        track, features = result
        for frame in later:
            track, found = detector.settle(detector.look(frame, self.seq + 1), frame, self.seq + 1, time)
            features = replace(found, training=features.training)
        return track, features

    def seek(self, name: str, model: Model, box: Box, similarity: Similarity) -> None:
        """Search for the object of a saved model from the next frame on; another one of this name is forgotten.

        Nothing changes after a ProtocolError, as of `Detector.seek`, or an ObjectError, as of `add`.
        """
        detector = self.detectors.get(name) or self._made(name)
        detector.seek(model, box, similarity, self.seq)
        self.detectors.pop(name, None)
        self.detectors[name] = detector  # the last one, as in `begin`

    def begin_all(self, boxes: Mapping[str, Box], frame: Pyramid, time: float = 0.0) -> dict[str, Result]:
        """Start several objects with their boxes in the next frame, by name; if `begin` refuses one, none of them."""
        trial = copy(self)
        trial.detectors = {name: copy(each) if name in boxes else each for name, each in self.detectors.items()}
        results = {name: trial.begin(name, frame, box, time) for name, box in boxes.items()}
        self.detectors = trial.detectors
        return results

    def correct(self, name: str, frame: Pyramid, box: Box, time: float = 0.0, later: Iterable[Pyramid] = ()) -> Result:
        """Continue an object at another box: see `Detector.correct`; the frames are as in `begin`."""
        detector = self.detectors[name]
        return self._caught_up(detector, detector.correct(frame, self.seq + 1, time, box), time, later)

    def step(
        self, frame: Pyramid, time: float = 0.0, given: Mapping[str, Result] | None = None
    ) -> tuple[Tracks, Features]:
        """Find the objects in the next frame, but those whose results `begin` and `correct` have `given`."""
        self.seq += 1
        results = dict(given or {})
        searched = {name: detector for name, detector in self.detectors.items() if name not in results}
        found = in_parallel(lambda detector: detector.look(frame, self.seq), searched.values())
        states = {name: detector.state for name, detector in searched.items() if detector.state is not None}
        resolved = assigned(dict(zip(searched, found, strict=True)), states, self.settings.search.context)
        settled = in_parallel(lambda name: searched[name].settle(resolved[name], frame, self.seq, time), searched)
        results |= zip(searched, settled, strict=True)
        names = [*self.detectors, *(name for name in results if name not in self.detectors)]
        tracks: dict[str, Track] = {name: results[name][0] for name in names}
        parts = {name: results[name][1] for name in names}
        return Tracks(self.seq, self.seq - 1, tracks), Features(self.seq, self.seq - 1, time, parts, self.network)

    def forget(self, name: str) -> None:
        """Stop tracking an object; ObjectError if there is none of this name."""
        if name not in self.detectors:
            raise ObjectError(f"there is no object {name!r}: the objects are {listed(self.detectors)}")
        del self.detectors[name]

    def adopt(self, model: Model) -> None:
        """Use a model for its object from now on, see `Detector.adopt`; one of a forgotten object is dropped."""
        if (detector := self.detectors.get(model.object)) is not None:
            detector.adopt(model)


def assigned(
    found: Mapping[str, Detection], states: Mapping[str, DetectorState], context: float
) -> dict[str, Detection]:
    """Give each place to one object, by name: first to the one whose score would fall most without it.

    An object that loses its place takes the best other window near it; its score is 0 if there is none. Objects whose
    first boxes overlapped may stay at the same place, and one that is still sought claims none. If no other object
    claims its place, a detection stays the same one.
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
