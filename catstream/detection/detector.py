"""The detector: frames in, tracks and features out (paper, "Classification")."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from catstream.box import Box
from catstream.detection import bootstrap, extent, lessons, search
from catstream.detection.balance import Balance
from catstream.detection.lessons import Lesson
from catstream.detection.motion import CentreFilter
from catstream.detection.search import Found
from catstream.errors import BoxError, ProtocolError
from catstream.features.cells import COLOURS, row_length
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.heads import APPEARANCE, EXTENT
from catstream.messages import DetectorState, Features, Model, State, Track, TrainingRows
from catstream.settings import Settings

if TYPE_CHECKING:
    from catstream.paper.scm import SparseCollaborativeModel

__all__ = ["Detector"]

_USUAL_RATE = 0.01  # share that a frame has in the score that the object usually has
_AGAIN_OVERLAP = 0.3  # above which two windows in successive frames are the same object
_SOUGHT_FACTORS = tuple(1.25**k for k in range(-4, 5))  # of the size of an object that is not found yet


class Detector:
    """Finds the object in each frame with the newest model, and cuts out what the frame teaches.

    Costs the same for every frame: a few small images around the object; the whole
    frame where it is not sure (or always, `detection="full"`).

    Call `init` with the first frame, or `seek` before it, then `step` for every other; `adopt` models as they come.

    Attributes
    ----------
    seq : of the last message
    model : the one in use
    heard : version of the newest model that came, in use or not
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.seq = 0
        self.state: State = "bootstrapping"
        self.model = Model(0, -1, np.empty(0, np.float32), 0.0)
        self.heard = 0
        self._started = False  # whether there is anything to follow
        self._forget()

    def _forget(self) -> None:
        """All but the stream of messages, which goes on."""
        self._first_frame = self.seq  # of this object: an older model is of another one
        self._usual_score = 0.0
        self._elsewhere = False  # found by a search of the whole frame, and not trusted yet
        self._sightings = 0  # frames in a row in which a saved model saw its object at one place
        self._first_box: Box | None = None  # None while it was not found yet
        self._centre: CentreFilter | None = None
        self._balance = Balance()
        self._scm: SparseCollaborativeModel | None = None

    def prepare(self) -> None:
        """Import what `init` needs, if that takes long."""
        if self.settings.teaching.bootstrap == "scm":
            from catstream.paper import scm

            scm.prepare()

    @property
    def box(self) -> Box | None:
        """Where the object was last, in pixels; None before the first frame."""
        return self._box.scaled(1 / self.settings.search.context) if self.seq and self._started else None

    def init(self, image: np.ndarray, box: Box, time: float = 0.0) -> tuple[Track, Features]:
        """Start on a box; what was followed before is forgotten.

        Parameters
        ----------
        image : uint8 (h, w, 3) BGR, or (h, w) grey
        box : the object, in pixels of the frame
        time : seconds since the start of the source

        Raises
        ------
        BoxError
            For a box that is no start for this frame (see `Box.inside`), or looks like what is around it.
            Nothing is forgotten then.
        """
        frame = Pyramid.of(image)
        # The window is wider than the object: the edge of an object tells most about where it is.
        box = Box(*map(float, box)).validated(*frame.size)
        window, scm = box.scaled(self.settings.search.context), None
        if self.settings.teaching.bootstrap == "scm":
            from catstream.paper.scm import SparseCollaborativeModel  # compiles a kernel of its own

            scm = SparseCollaborativeModel(image, box, self._random())
            lesson = lessons.near(frame, window, None, self._random(), self.settings)
            lesson = lessons.with_extents(lesson, frame, window, self.settings)
        else:
            lesson = lessons.first(frame, window, self._random(), self.settings)
        model = bootstrap.stand_in(lesson)
        lesson += lessons.far(frame, window, model, self.settings)
        model = bootstrap.stand_in(lesson)
        self._forget()
        self._box = self._sure_box = self._first_box = window
        self.model, self._scm, self._started = model, scm, True
        self.seq, self.state = self.seq + 1, "bootstrapping"
        return self._answer(time, 1.0, lesson, begins=True)

    def seek(self, model: Model, box: Box) -> None:
        """Start with a model: the object is absent until it is found, in whichever frame and size that is.

        It is found at the window that scores `belief.sighting_lead` higher than the rest of the frame, in
        `belief.sighting_frames` frames in a row: of two objects that look alike, neither.

        Parameters
        ----------
        box : in pixels, about as large as the object may be

        Raises
        ------
        ProtocolError
            For a model of other features.
        """
        if len(model.weights) != row_length():
            raise ProtocolError(
                f"the model has {len(model.weights)} weights, the features of a window are {row_length()}: "
                "learn it anew with this catstream"
            )
        self._box = self._sure_box = box.scaled(self.settings.search.context)
        self.state, self._started = "absent", True
        self.adopt(model)

    def correct(self, image: np.ndarray, box: Box, time: float = 0.0) -> tuple[Track, Features]:
        """Go on with the same object at another box, whatever a search would have found.

        Raises
        ------
        BoxError
            As `init` does.
        """
        frame = Pyramid.of(image)
        self._box = self._sure_box = Box(*map(float, box)).validated(*frame.size).scaled(self.settings.search.context)
        self.seq, self.state = self.seq + 1, "present"
        self._elsewhere, self._first_box = False, self._first_box or self._box
        self._balance = Balance()  # this box says anew where in it the colours lie
        if self._centre is not None:
            self._centre.predict()
            self._centre.update(self._box.centre)
        score = float(search.scored_around(frame, self._box, WINDOW, self.model).scores[0, 0])
        lesson = lessons.near(frame, self._box, self.model, self._random(), self.settings)
        lesson = lessons.with_extents(lesson, frame, self._box, self.settings)
        return self._answer(time, score, lesson)

    def miss(self, time: float = 0.0) -> tuple[Track, Features]:
        """Let a frame pass unseen: the object counts as absent."""
        self.seq, self.state = self.seq + 1, "absent"
        return self._answer(time, 0.0, Lesson.none())

    def adopt(self, model: Model) -> None:
        """Go on with a model, unless it is older than the newest that came, or of an object before this one."""
        if model.version <= self.heard:
            return
        self.heard = model.version
        if model.frame < self._first_frame or not self._started:
            return
        self.model, self._scm = model, None
        if model.motion is not None and self.seq:
            if self._centre is None:
                self._centre = CentreFilter(model.motion, self._box.centre)
            else:
                self._centre.adopt(model.motion)

    def resume(self, seq: int, detector: DetectorState, model: Model) -> None:
        """Go on after message `seq` of a stream that another detector began.

        With the model that the other one had by then, it goes on as that would have, bit for bit.

        Parameters
        ----------
        seq : the last Features that is stored
        detector : that of that message, or `state_at` where the object was last
        model : the newest there is
        """
        self.seq, self.state, self._started = seq, detector.state, True
        self._first_box = detector.first
        self._box, self._sure_box = detector.window, detector.sure
        self._usual_score, self._elsewhere = detector.usual, detector.elsewhere
        self._sightings = detector.sightings
        if detector.motion is not None and detector.centre is not None:
            self._centre = CentreFilter.resumed(detector.motion, detector.centre, detector.state != "absent")
        if detector.balance is not None:
            self._balance = Balance.resumed(detector.balance)
        if not model.version:
            self.model = model  # what stands in before the first one
        self.adopt(model)

    def bootstrap_state(self) -> tuple[dict[str, np.ndarray], dict[str, Any] | None]:
        """Arrays and facts of the sparse collaborative model, for `resume_bootstrap`; none if it is not in use."""
        return ({}, None) if self._scm is None else self._scm.state()

    def resume_bootstrap(self, arrays: dict[str, np.ndarray], facts: dict[str, Any] | None) -> None:
        """Go on with the sparse collaborative model that another detector followed the object by, after `resume`."""
        if facts is not None:
            from catstream.paper.scm import SparseCollaborativeModel

            self._scm = SparseCollaborativeModel.resumed(arrays, facts)

    def state_at(self, box: Box, first: Box) -> DetectorState:
        """Where nothing is known but where the object was last, and in its first frame."""
        window = box.scaled(self.settings.search.context)
        return DetectorState("present", window, window, first.scaled(self.settings.search.context), 0.0, False)

    def step(self, image: np.ndarray, time: float = 0.0) -> tuple[Track, Features]:
        """Find the object in the next frame."""
        settings = self.settings
        if not self._started:
            raise BoxError("there is no box to follow yet: call init with a frame and a box first")
        self.seq += 1
        if self._centre is not None:
            self._box = self._box.centred(*self._centre.predict())
        frame = Pyramid.of(image)
        if self._scm is not None:
            score, box = self._scm.step(image)  # it has no word for absent
            self._box = box.scaled(settings.search.context).with_centre_in(*frame.size)
            return self._answer(time, score, self._lesson(frame, Found(score, self._box)))
        found = self._find(frame) if self._first_box else self._seek(frame)
        self._elsewhere &= found.score < settings.belief.trust_score
        there = self._first_box is not None and self._there(found.score)
        if there:
            self.state = "present" if self.model.version else "bootstrapping"
            self._box = self._balanced(extent.followed(self._box, found, settings), found).with_centre_in(*frame.size)
            if found.score >= settings.belief.confident_score:
                self._sure_box = self._box
        else:
            self.state = "absent"
        if self._centre is not None:
            self._centre.update(self._box.centre if there else None)
        return self._answer(time, found.score, self._lesson(frame, found) if there else Lesson.none())

    def _there(self, score: float) -> bool:
        """Whether the best score in a frame is the object's: high enough, also for what this one usually scores."""
        settings = self.settings
        if self.state == "absent":
            there = score >= max(settings.belief.return_score, settings.belief.return_share * self._usual_score)
        else:
            there = score >= max(settings.belief.present_score, settings.belief.present_share * self._usual_score)
        if there:
            self._usual_score += _USUAL_RATE * (score - self._usual_score)
        return there

    def _balanced(self, box: Box, found: Found) -> Box:
        """The box, drawn after the object's colours if it crept off them."""
        settings = self.settings
        if found.around is None or self._elsewhere or found.score < settings.belief.extent_score:
            return box
        return self._balance.drawn(box, found.around, self.model.weights[COLOURS], settings.extent.colour_slack)

    def _find(self, frame: Pyramid) -> Found:
        settings = self.settings
        surely = self._sure_box.centred(*self._box.centre)  # as large as it surely was
        if settings.search.mode == "full":
            doubtful = self._elsewhere or self.state == "absent"
            found = self._fitted(frame, search.whole(frame, surely if doubtful else self._box, self.model, settings))
            self._elsewhere |= not found.box.overlap(self._box)
            return found
        found = self._fitted(frame, search.local(frame, self._box, self.model, settings))
        lost = found.score < settings.belief.lost_score
        unsure = found.score < settings.belief.confident_score or self._elsewhere
        if lost or (unsure and self.seq % settings.search.whole_interval == 0):
            other = search.whole(frame, surely, self.model, settings)
            if other.score > settings.belief.return_score and other.score > found.score + settings.belief.jump_margin:
                other = self._fitted(frame, search.local(frame, other.box, self.model, settings))
                if other.score > found.score:
                    self._elsewhere = True
                    return other
        return found

    def _seek(self, frame: Pyramid) -> Found:
        """The best window of the whole frame, of any size that the object may have.

        The object counts as found once this window has led the rest of the frame at one place in several
        frames in a row. While nothing scores high, each frame is searched at a third of the sizes.
        """
        settings = self.settings
        third = _SOUGHT_FACTORS[self.seq % 3 :: 3]
        found, lead = search.sought(frame, self._box, third, self.model, settings)
        if self._sightings or found.score >= settings.belief.return_score:
            found, lead = search.sought(frame, self._box, _SOUGHT_FACTORS, self.model, settings)
        seen = found.score >= settings.belief.return_score and lead >= settings.belief.sighting_lead
        again = self._sightings and found.box.overlap(self._sure_box) > _AGAIN_OVERLAP
        self._sightings = (self._sightings + 1 if again else 1) if seen else 0
        self._sure_box = found.box
        if self._sightings < settings.belief.sighting_frames:
            return found
        self._box = self._first_box = found.box
        self._elsewhere = True
        return self._fitted(frame, found)

    def _fitted(self, frame: Pyramid, found: Found) -> Found:
        fitted = extent.fitted(frame, found.box, self._first_box or found.box, self.model, self.settings)
        return replace(fitted, around=found.around)

    def _lesson(self, frame: Pyramid, found: Found) -> Lesson:
        settings = self.settings
        if found.score < settings.belief.teach_score or self._elsewhere:
            return Lesson.none()
        lesson = lessons.near(frame, self._box, self.model, self._random(), settings, found.around)
        if self.seq % settings.extent.interval == 0:
            lesson = lessons.with_extents(lesson, frame, self._box, settings)
        if found.score > settings.belief.mine_score and self.seq % settings.teaching.mining_interval == 0:
            lesson += lessons.far(frame, self._box, self.model, settings)
        return lesson

    def _random(self) -> np.random.Generator:
        """A fresh generator for each frame: what a frame teaches does not depend on the ones before."""
        return np.random.default_rng((self.settings.run.seed, self.seq))

    def _answer(self, time: float, score: float, lesson: Lesson, *, begins: bool = False) -> tuple[Track, Features]:
        seq, frame = self.seq, self.seq - 1
        box = None if self.state == "absent" else self.box
        track = Track(seq, frame, time, self.state, box, float(score), self.model.version)
        groups = {
            APPEARANCE: TrainingRows(lesson.rows, lesson.labels, lesson.weights),
            EXTENT: TrainingRows(lesson.extents, lesson.fits, np.ones_like(lesson.fits)),
        }
        training = {name: rows for name, rows in groups.items() if len(rows)}
        return track, Features(seq, frame, time, box, training, self._detector_state(), begins)

    def _detector_state(self) -> DetectorState | None:
        if not self._started:
            return None
        motion, centre = (self._centre.motion, self._centre.state) if self._centre is not None else (None, None)
        boxes = self._box, self._sure_box, self._first_box
        usual, balance = float(self._usual_score), self._balance.state.copy()
        return DetectorState(self.state, *boxes, usual, self._elsewhere, motion, centre, balance, self._sightings)
