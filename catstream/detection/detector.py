"""The detector: frames in, tracks and training rows out. It holds state and model from one frame to the next."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from catstream.box import Box, Window
from catstream.detection import motion, teacher
from catstream.detection.search import Detection, ScoreMap
from catstream.detection.step import step, track_of
from catstream.detection.teacher import Training
from catstream.errors import BoxError, ProtocolError
from catstream.features.cells import row_length
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.messages import DetectorState, Features, Model, Track
from catstream.settings import Settings
from catstream.storage import Arrays, Metadata

if TYPE_CHECKING:
    from catstream.paper.scm import SparseCollaborativeModel

__all__ = ["Detector"]


class Detector:
    """Follows one object with the newest model.

    Call `init` with the first frame, or `seek` before it, then `step` for every other; `adopt` models as they arrive.

    Attributes
    ----------
    seq : of the last message
    state : after the last frame, None before there is an object; with the model, and SCM if it is in use, all there is
    model : the one in use
    newest_version : of the models that arrived, in use or not
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.seq = 0
        self.state: DetectorState | None = None
        self.model = Model(0, -1, np.empty(0, np.float32), 0.0)
        self.newest_version = 0
        self._scm: SparseCollaborativeModel | None = None

    def prepare(self) -> None:
        """Import what `init` needs, if that takes long."""
        if self.settings.teaching.bootstrap == "scm":
            from catstream.paper import scm

            scm.prepare()

    @property
    def box(self) -> Box | None:
        """The last box of the object, in pixels; None before the first frame."""
        return self.state.window.box(self.settings.search.context) if self.seq and self.state else None

    def init(self, image: np.ndarray, box: Box, time: float = 0.0) -> tuple[Track, Features]:
        """Start with the box of an object; another one before it is forgotten.

        Parameters
        ----------
        image : uint8 (h, w, 3) BGR, or (h, w) grey
        box : the object, in pixels of the frame
        time : seconds since the start of the source

        Raises
        ------
        BoxError
            If tracking cannot start with the box in this frame (see `Box.validated`), or if the object looks like
            what is around it. The detector stays as it was.
        """
        frame, scm = Pyramid.of(image), None
        box = Box(*map(float, box)).validated(*frame.size)
        window, rng = Window.around(box, self.settings.search.context), (self.settings.run.seed, self.seq)
        if self.settings.teaching.bootstrap == "scm":
            from catstream.paper.scm import SparseCollaborativeModel  # compiles a kernel of its own

            scm = SparseCollaborativeModel(image, box, np.random.default_rng(rng))
        model, training = teacher.first_training(frame, window, np.random.default_rng(rng), self.settings)
        self.state, self.model, self._scm = DetectorState(self.seq, "confident", window, window, window), model, scm
        self.seq += 1
        return self._messages(track_of(self.state, self.seq, time, 1.0, model, self.settings), training, begins=True)

    def seek(self, model: Model, box: Box) -> None:
        """Start with a model: the object is absent until it is found, in whichever frame and size that is.

        It is found at the window that scores `sighting_lead` higher than the rest of the frame, in `sighting_frames`
        frames in a row: of two objects that look alike, neither.

        Parameters
        ----------
        box : in pixels, about as large as the object may be

        Raises
        ------
        ProtocolError
            If the model is of other features.
        """
        if len(model.weights) != row_length():
            raise ProtocolError(
                f"the model has {len(model.weights)} weights, the features of a window are {row_length()}: "
                "learn it anew with this catstream"
            )
        window = Window.around(box, self.settings.search.context)
        self.state = DetectorState(0, "lost", window, window, None)
        self.model, self.newest_version = model, model.version

    def step(self, image: np.ndarray, time: float = 0.0) -> tuple[Track, Features]:
        """Find the object in the next frame."""
        if self.state is None:
            raise BoxError("there is no box to follow yet: call init with a frame and a box first")
        frame = Pyramid.of(image)
        self.seq += 1
        found = None
        if self._scm is not None:
            score, box = self._scm.follow(image)
            found = Detection(score, Window.around(box, self.settings.search.context).with_centre_in(*frame.size))
        state = self.state
        self.state, track, training = step(state, frame, self.seq, time, self.model, self.settings, found)
        return self._messages(track, training)

    def correct(self, image: np.ndarray, box: Box, time: float = 0.0) -> tuple[Track, Features]:
        """Continue with the same object at another box, whatever a search would have found.

        Raises
        ------
        BoxError
            If there is no object yet, or as `init` does.
        """
        if self.state is None:
            raise BoxError("there is no box to follow yet: call init with a frame and a box first")
        frame = Pyramid.of(image)
        window = Window.around(Box(*map(float, box)).validated(*frame.size), self.settings.search.context)
        self.seq += 1
        self.state = motion.observed(
            replace(
                motion.expected(self.state),
                level="confident",
                trusted=True,
                window=window,
                confident_window=window,
                first_window=self.state.first_window or window,
                colour_centroid=None,  # this box shows anew where in it the colours are
            )
        )
        score = float(ScoreMap.around(frame, window, WINDOW, self.model).scores[0, 0])
        training = teacher.training_at(frame, window, self.seq, self.model, self.settings)
        return self._messages(track_of(self.state, self.seq, time, score, self.model, self.settings), training)

    def miss(self, time: float = 0.0) -> tuple[Track, Features]:
        """Let a frame pass without a search: the object counts as absent."""
        self.seq += 1
        if self.state is not None:
            self.state = replace(self.state, level="lost")
        track = Track(self.seq, self.seq - 1, time, "absent", None, 0.0, self.model.version)
        return self._messages(track, {})

    def adopt(self, model: Model) -> None:
        """Use a model from now on, unless it is older than the newest that arrived, or of an object before this one."""
        if model.version <= self.newest_version:
            return
        self.newest_version = model.version
        if self.state is not None and model.frame >= self.state.first_frame:
            self.model, self._scm = model, None
            if model.motion is not None:
                self.state = replace(self.state, motion=model.motion)

    def resume(self, seq: int, state: DetectorState, model: Model) -> None:
        """Continue after message `seq` of a stream that another detector began.

        With the model that the other one had by then, it continues as that would have, bit for bit.

        Parameters
        ----------
        seq : the last Features that is stored
        state : that of this message, or `state_at` the box where the object was last
        model : the newest there is
        """
        self.seq, self.model, self.newest_version = seq, model, model.version
        self.state = state if model.motion is None else replace(state, motion=model.motion)

    def state_at(self, box: Box, first: Box) -> DetectorState:
        """The state if nothing is known but the boxes of the object in the last frame and in its first one."""
        context = self.settings.search.context
        window = Window.around(box, context)
        return DetectorState(0, "confident", window, window, Window.around(first, context))

    def scm_state(self) -> tuple[Arrays, Metadata | None]:
        """Arrays and metadata of the paper's first tracker, for `resume_scm`; none if it is not in use."""
        return ({}, None) if self._scm is None else self._scm.state()

    def resume_scm(self, arrays: Arrays, metadata: Metadata | None) -> None:
        """Continue the paper's first tracker of another detector; call it after `resume`."""
        if metadata is not None:
            from catstream.paper.scm import SparseCollaborativeModel

            self._scm = SparseCollaborativeModel.resumed(arrays, metadata)

    def _messages(self, track: Track, training: Training, *, begins: bool = False) -> tuple[Track, Features]:
        return track, Features(track.seq, track.frame, track.time, track.box, training, self.state, begins)
