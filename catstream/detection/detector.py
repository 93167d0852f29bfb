"""The detector of one object: frames in, tracks and training rows out (paper, "Classification").

It holds state and model between the frames. The steps from one frame to the next are the pure functions `looked`,
`settled` and `taught`: the same state, frame, model and settings give the same result.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.detection import belief, extent, search, teacher
from catstream.detection.search import Detection
from catstream.detection.similarity import Similarity
from catstream.detection.teacher import Training
from catstream.errors import BoxError, ProtocolError
from catstream.features.cells import Cells
from catstream.features.descriptor import Descriptor
from catstream.features.layout import WINDOW, row_length
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap
from catstream.messages.kinds import DetectorState, Model, ObjectFeatures, State, Track

if TYPE_CHECKING:
    from catstream.paper.scm import SparseCollaborativeModel

#: The track and the features of an object in one frame.
Result = tuple[Track, ObjectFeatures]

_STILL_INTERVAL = 7  # frames from one taught frame of a still scene to the next; not even, as other intervals are
_EXPLAINED = 0.9  # score from which the model explains a frame; the mean of the object has the score 1
_YOUNG = 50  # frames of an object that are all taught


class Detector:
    """Follows one object with the newest model.

    Call `init` with the first frame, or `seek` before it. For every other frame call `look`, then `settle`; `adopt`
    models as they arrive.

    state           after the last frame, None before there is an object; with the model, and SCM if in use, all there
    is newest_version  of the models that arrived, in use or not
    similarity        to the object of a saved model, used until that is found; None without a saved model
    """

    def __init__(self, settings: Settings, name: str = "", descriptor: Descriptor | None = None) -> None:
        self.settings, self.name, self.descriptor = settings, name, descriptor
        self.state: DetectorState | None = None
        self.model = Model(0, -1, np.empty(0, np.float32), 0.0)
        self.newest_version = 0
        self._scm: SparseCollaborativeModel | None = None
        self._taught: tuple[int, Cells] | None = None  # number of the last frame that was taught, and the cells around
        self.similarity: Similarity | None = None

    @property
    def box(self) -> Box | None:
        """The last box of the object, in pixels; None before the first frame."""
        return self.state.window.box(self.settings.search.context) if self.state else None

    def init(self, frame: Pyramid, seq: int, time: float, box: Box) -> Result:
        """Start with the box of an object in pixels of the frame; another one before it is forgotten.

        BoxError if tracking cannot start with the box in this frame (see `Box.validated`), or if the object looks like
        what is around it. The detector stays as it was.
        """
        scm = None
        box = Box(*map(float, box)).validated(*frame.size)
        window, rng = Window.around(box, self.settings.search.context), (self.settings.run.seed, seq - 1)
        if self.settings.teaching.bootstrap == "scm":
            from catstream.paper.scm import SparseCollaborativeModel  # compiles a kernel of its own

            scm = SparseCollaborativeModel(frame.image, box, np.random.default_rng(rng))
        model, training = teacher.first_training(frame, window, np.random.default_rng(rng), self.settings)
        self.state, self.model, self._scm = DetectorState(seq - 1, "confident", window, window, window), model, scm
        return self._result(seq, time, 1.0, training)

    def seek(self, model: Model, box: Box, similarity: Similarity, frame: int = 0) -> None:
        """Start with a saved model: the object is absent until it is found, in whichever frame and size that is.

        Another object before it is forgotten. `box` in pixels is about as large as the object may be, and `frame` is
        the number of the first one that is searched. It is found at a window that looks like the object and scores
        higher than the rest of the frame, in several successive frames. Of two objects that look alike, neither is
        found. ProtocolError if the model is of other features.
        """
        if len(model.weights) != (width := row_length(self.descriptor.channels if self.descriptor is not None else 0)):
            raise ProtocolError(
                f"the model has {len(model.weights)} weights, the features of a window are {width}: "
                "learn it again with this catstream"
            )
        window = Window.around(box, self.settings.search.context)
        self.state = DetectorState(frame, "lost", window, window, None)
        self.model, self.similarity, self._scm = replace(model, began=frame), similarity, None
        self.newest_version = max(self.newest_version, model.version)

    def look(self, frame: Pyramid, seq: int) -> Detection:
        """Search the object in the next frame. The state then has the place that was expected."""
        if self._scm is not None:
            score, box = self._scm.follow(frame.image)
            return Detection(score, Window.around(box, self.settings.search.context).with_centre_in(*frame.size))
        self.state, found = looked(self._known(), frame, seq, self.model, self.similarity, self.settings)
        return found

    def settle(self, found: Detection, frame: Pyramid, seq: int, time: float) -> Result:
        """Take the detection of `look`, or another one of the same frame, and cut the training rows."""
        state, model, settings = self._known(), self.model, self.settings
        if self._scm is None:
            state = settled(state, found, frame.size, settings)
        else:  # never absent: the first leaf is of the first n frames, whatever the score of this tracker is
            state = replace(state, level="confident", window=found.window)
        self.state = state
        if self._is_explained(found, seq) or self._is_still(found, seq):
            return self._result(seq, time, found.score, {})
        training = taught(state, found, frame, seq, model, self.similarity, settings)
        self._taught = (seq, found.around.cells) if training and found.around is not None else None
        return self._result(seq, time, found.score, training)

    def _is_explained(self, found: Detection, seq: int) -> bool:
        """Whether the model explains the object in a frame that is not due (docs/paper.md)."""
        state = self._known()
        if not self.model.version or state.level != "confident" or seq - state.first_frame <= _YOUNG:
            return False
        # One frame of each block is due, and in the next block the one after it, as other intervals are even. Several
        # objects are taught in different frames, as far as their names allow.
        interval = self.settings.teaching.interval
        block, place = divmod(seq + crc32(self.name.encode()), interval)
        return found.score >= _EXPLAINED and place != block % interval

    def _is_still(self, found: Detection, seq: int) -> bool:
        """Whether the surroundings of the object are still those of a recent frame that was taught (docs/paper.md)."""
        if found.around is None or self._taught is None or not self.model.version:
            return False
        number, cells = self._taught
        return seq - number < _STILL_INTERVAL and found.around.cells.differs_by_noise(cells)

    def correct(self, frame: Pyramid, seq: int, time: float, box: Box) -> Result:
        """Continue with the same object at another box, whatever a search would have found.

        BoxError if there is no object yet, or as `init` does.
        """
        state = self._known()
        window = Window.around(Box(*map(float, box)).validated(*frame.size), self.settings.search.context)
        self.state = belief.observed(
            replace(
                belief.expected(state),
                level="confident",
                trusted=True,
                window=window,
                confident_window=window,
                first_window=state.first_window or window,
            )
        )
        score = float(ScoreMap.around(frame, window, WINDOW, self.model).scores[0, 0])
        training = teacher.training_at(frame, window, seq, self.model, self.settings)
        return self._result(seq, time, score, training)

    def adopt(self, model: Model) -> None:
        """Use a model from now on, unless it is older than the newest that arrived, or of an object before this one."""
        if model.version <= self.newest_version:
            return
        self.newest_version = model.version
        if self.state is not None and model.began == self.state.first_frame:
            self.model, self._scm = model, None
            if model.motion is not None:
                self.state = replace(self.state, motion=model.motion)

    def resume(self, state: DetectorState, model: Model) -> None:
        """Continue after a frame of a stream that another detector began, with the state after it and the newest model.

        With the model that the other one had by then, it continues as that would have, bit for bit.
        """
        self.model, self.newest_version = model, model.version
        self.state = state if model.motion is None else replace(state, motion=model.motion)

    def _known(self) -> DetectorState:
        if self.state is None:
            raise BoxError("there is no box to follow yet: call init with a frame and a box first")
        return self.state

    def _result(self, seq: int, time: float, score: float, training: Training) -> Result:
        """The track and the features of a frame; no box is reported if the level of belief forbids it."""
        state, version = self._known(), self.model.version
        reported = _policy(state, self.settings).report
        box = state.window.box(self.settings.search.context) if reported else None
        present: State = "present" if version else "bootstrapping"
        shown: State = present if reported else "absent"
        began, doubtful = state.first_frame, state.level in ("weak", "redetected")
        track = Track(
            *(seq, seq - 1, time, shown, box, float(score), version), object=self.name, began=began, doubtful=doubtful
        )
        return track, ObjectFeatures(box, training, state, begins=began == seq - 1)


def looked(
    state: DetectorState, frame: Pyramid, seq: int, model: Model, similarity: Similarity | None, settings: Settings
) -> tuple[DetectorState, Detection]:
    """Search the object in the next frame; returns the state with the place that was expected, and the detection.

    Costs the same for every frame: a few small patches around the object, and the whole frame if the belief is low (or
    always, if `search.mode` is "full"), or as long as the object of a saved model with this similarity is sought.
    """
    state = belief.expected(state)
    if state.first_window is None and similarity is not None:
        return search.seek(frame, state, seq, model, similarity, settings)
    return state, search.find(frame, state, seq, model, settings)


def settled(state: DetectorState, found: Detection, size: tuple[int, int], settings: Settings) -> DetectorState:
    """The state after a detection: its belief in it, and the window moved as far as the belief allows."""
    state = belief.updated(state, found.score, found.redetected, settings.belief)
    policy = _policy(state, settings)
    if not policy.report:
        return state
    window = extent.followed(state.window, found.window, policy.resize).with_centre_in(*size)
    confident = window if policy.resize else state.confident_window
    return belief.observed(replace(state, window=window, confident_window=confident))


def taught(
    state: DetectorState,
    found: Detection,
    frame: Pyramid,
    seq: int,
    model: Model,
    similarity: Similarity | None,
    settings: Settings,
) -> Training:
    """The training rows of a frame, as far as the belief in its detection allows."""
    if state.first_window is None and similarity is not None:
        return teacher.training_beside(frame, found.window, model, similarity, settings)
    if not _policy(state, settings).teach:
        return {}
    return teacher.training_of(frame, state.window, found.around, seq, model, settings)


def _policy(state: DetectorState, settings: Settings) -> belief.Policy:
    return belief.policies(settings.search.whole_interval)[state.level]
