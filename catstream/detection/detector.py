"""The detector of one object: frames in, tracks and training rows out (paper, "Classification").

Its state and model are the only memory between frames: the same state, model, frame and settings give the same result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.detection import belief, extent, search, teacher
from catstream.detection.context import FrameContext
from catstream.detection.search import Detection
from catstream.detection.similarity import Similarity
from catstream.detection.teacher import Training
from catstream.errors import BoxError
from catstream.features.cells import Cells
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.wire.messages import DetectorState, Model, ObjectFeatures, State, Track

if TYPE_CHECKING:
    from catstream.detection.scm import SparseCollaborativeModel

#: The track and the features of an object in one frame.
Result = tuple[Track, ObjectFeatures]

_STILL_INTERVAL = 7  # frames from one training frame of a still scene to the next; odd, as other intervals are even
_EXPLAINED = 0.9  # minimum score of a frame that need not be trained on; the mean of the object has the score 1
_FIRST_FRAMES = 50  # frames of an object that are all used for training


class Detector:
    """Tracks one object with the newest model.

    Call `init` with the first frame, or `seek` before it. For every other frame call `search`, then `update`; `adopt`
    models as they arrive.
    """

    def __init__(self, settings: Settings, name: str = "") -> None:
        self.settings, self.name = settings, name
        #: State after the last frame. It, the model and SCM determine the next result.
        self.state: DetectorState | None = None
        self.model = Model(0, -1, np.empty(0, np.float32), 0.0)  #: for the next frame
        self.newest_version = 0  #: of the received models, even if it is not in use
        #: Similarity to the object of a saved model, for its first detection.
        self.similarity: Similarity | None = None
        self._scm: SparseCollaborativeModel | None = None
        self._last_training: tuple[int, Cells] | None = None  # seq of the last training frame, and the cells around

    @property
    def box(self) -> Box | None:
        """The last box of the object, in pixels; None before the first frame."""
        return self.state.window.box() if self.state else None

    def init(
        self, frame: Pyramid, seq: int, time: float, box: Box, together: Mapping[str, int] = MappingProxyType({})
    ) -> Result:
        """Start with the box of an object in pixels of the frame; a previous object is forgotten.

        `together` becomes part of the state: the objects whose boxes overlap this one.

        BoxError if tracking cannot start with the box in this frame (see `Box.validated`), or if the object is
        indistinguishable from its background. The detector is then unchanged.
        """
        scm = None
        box = Box(*map(float, box)).validated(*frame.size)
        window = Window.around(box)
        seed = (self.settings.run.seed, seq - 1)
        if self.settings.training.bootstrap == "scm":
            from catstream.detection.scm import SparseCollaborativeModel  # compiles a kernel of its own

            scm = SparseCollaborativeModel(frame.image, box, np.random.default_rng(seed))
        model, training = teacher.first_training(frame, window, np.random.default_rng(seed), self.settings)
        self.state = DetectorState(seq - 1, "confident", window, window, window, together=dict(together))
        self.model, self._scm = model, scm
        return self._result(seq, time, 1.0, training)

    def seek(self, model: Model, box: Box, similarity: Similarity, frame: int = 0) -> None:
        """Start with a saved model: the object is absent until it is detected, in any frame and at any size.

        A previous object is forgotten. `box` is of about the expected size, in pixels, and `frame` is the number of the
        first frame to search. The object is detected at a window that is similar to it and scores higher than the rest
        of the frame, in several successive frames; of two similar objects, neither is.
        """
        window = Window.around(box)
        self.state = DetectorState(frame, "lost", window, window, None)
        self.model, self.similarity, self._scm = replace(model, began=frame), similarity, None
        self.newest_version = max(self.newest_version, model.version)

    def search(self, frame: Pyramid, seq: int) -> Detection:
        """Search for the object in the next frame. The state then has the predicted window.

        Costs the same for every frame: a few small patches around the object, and the whole frame while the belief is
        low (or always, if `search.mode` is "full"), or until the first detection of a saved model's object.
        """
        if self._scm is not None:
            score, box = self._scm.track(frame.image)
            return Detection(score, Window.around(box).with_centre_in(*frame.size))
        context = self._context(frame, seq)
        self.state = belief.predict_window(self._current_state())
        if self.state.is_searched and self.similarity is not None:
            self.state, detection = search.seek(context, self.state, self.similarity)
            return detection
        return search.find(context, self.state)

    def update(self, detection: Detection, frame: Pyramid, seq: int, time: float) -> Result:
        """Update the state by the detection of `search`, or another one in the same frame, and cut training rows."""
        state = self._current_state()
        # Step 1: update the belief, and move the window as it allows.
        if self._scm is not None:  # never absent: the first leaf consists of the first n frames at any score
            state = replace(state, level="confident", window=detection.window)
        else:
            state = belief.update_level(state, detection.score, detection.redetected, self.settings.belief)
            policy = self._policy(state)
            if policy.report:
                window = extent.smooth(state.window, detection.window, resize=policy.resize).with_centre_in(*frame.size)
                confident = window if policy.resize else state.confident_window
                state = belief.update_motion(replace(state, window=window, confident_window=confident))
        self.state = state
        # Step 2: cut the training rows, if the belief in the detection allows it and they show something new.
        if self._is_explained(detection, seq) or self._is_still(detection, seq):
            return self._result(seq, time, detection.score, {})
        context, training = self._context(frame, seq), {}
        if state.is_searched and self.similarity is not None:
            training = teacher.training_of_background(context, detection.window, self.similarity)
        elif self._policy(state).teach:
            training = teacher.training_of(context, state.window, detection.around)
        self._last_training = (seq, detection.around.cells) if training and detection.around is not None else None
        return self._result(seq, time, detection.score, training)

    def _context(self, frame: Pyramid, seq: int) -> FrameContext:
        return FrameContext(frame, self.model, self.settings, seq)

    def _policy(self, state: DetectorState) -> belief.Policy:
        return belief.policies(self.settings.search.full_interval)[state.level]

    def _is_explained(self, detection: Detection, seq: int) -> bool:
        """Return True if the score is high enough to skip training on this frame (docs/paper.md)."""
        state = self._current_state()
        if not self.model.version or state.level != "confident" or seq - state.first_frame <= _FIRST_FRAMES:
            return False
        # One frame of each block trains, and in the next block the one after it, because other intervals are even. The
        # checksum of the name distributes several objects over the frames of a block.
        block, position = divmod(seq + crc32(self.name.encode()), self.settings.training.interval)
        is_selected = position == block % self.settings.training.interval
        return detection.score >= _EXPLAINED and not is_selected

    def _is_still(self, detection: Detection, seq: int) -> bool:
        """Return True if the region around the object is unchanged since a recent training frame (docs/paper.md)."""
        if detection.around is None or self._last_training is None or not self.model.version:
            return False
        number, cells = self._last_training
        return seq - number < _STILL_INTERVAL and detection.around.cells.differs_by_noise(cells)

    def correct(self, frame: Pyramid, seq: int, time: float, box: Box) -> Result:
        """Continue with the same object at another box, in place of a search.

        BoxError if there is no object yet, or as `init` does.
        """
        state = self._current_state()
        window = Window.around(Box(*map(float, box)).validated(*frame.size))
        self.state = belief.update_motion(
            replace(
                belief.predict_window(state),
                level="confident",
                trusted=True,
                window=window,
                confident_window=window,
                first_window=state.first_window or window,
            )
        )
        context = self._context(frame, seq)
        score = float(context.scores_around(window, WINDOW).scores[0, 0])
        return self._result(seq, time, score, teacher.training_at(context, window))

    def adopt(self, model: Model) -> None:
        """Use a model from now on, unless it is older than the newest one, or belongs to a previous object."""
        if model.version <= self.newest_version:
            return
        self.newest_version = model.version
        if self.state is not None and model.began == self.state.first_frame:
            self.model, self._scm = model, None
            if model.motion is not None:
                self.state = replace(self.state, motion=model.motion)

    def resume(self, state: DetectorState, model: Model) -> None:
        """Continue from the state of another detector after a frame, with the newest model.

        With the model that the other detector had in that frame, the results are the same, bit for bit.
        """
        self.model, self.newest_version = model, model.version
        self.state = state if model.motion is None else replace(state, motion=model.motion)

    def _current_state(self) -> DetectorState:
        if self.state is None:
            raise BoxError("no object is tracked yet: call init with a frame and a box first")
        return self.state

    def _result(self, seq: int, time: float, score: float, training: Training) -> Result:
        """The track and the features of a frame; the level of belief decides whether a box is reported."""
        state, version = self._current_state(), self.model.version
        reported = self._policy(state).report
        box = state.window.box() if reported else None
        label: State = "absent" if not reported else "present" if version else "bootstrapping"
        began = state.first_frame
        doubtful = state.level in ("weak", "redetected")
        track = Track(
            seq - 1, time, label, box, float(score), version, object=self.name, began=began, doubtful=doubtful
        )
        return track, ObjectFeatures(box, training, state, begins=began == seq - 1)
