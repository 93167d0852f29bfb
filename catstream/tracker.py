"""The tracker: detector, compressor and trainer in one process, one after the other.

The paper's three components in the order of its system figure: each frame is
searched with the last model, what it teaches is added to the coreset trees, and
a model is learned whenever they have grown. `catstream.pipeline` runs the same
three side by side.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from catstream import kalman
from catstream.box import Box
from catstream.compression.compressor import Compressor
from catstream.detection.detector import Detector
from catstream.errors import BoxError
from catstream.messages import Features, Track
from catstream.settings import Settings
from catstream.training.trainer import Trainer

__all__ = ["Tracker"]


class Tracker:
    """Follows one object, frame by frame; used like a `cv2.Tracker`.

    The same frames and settings give the same boxes, bit for bit.

    Parameters
    ----------
    settings : all defaults where None

    >>> frame = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    >>> tracker = Tracker()
    >>> tracker.init(frame, (60, 40, 40, 40))
    >>> ok, box = tracker.update(np.roll(frame, 2, axis=1))
    >>> ok, box.overlap(Box(62, 40, 40, 40)) > 0.9
    (True, True)
    """

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self._track: Track | None = None

    @property
    def track(self) -> Track:
        """The full result for the last frame: state, score, model version.

        Raises
        ------
        BoxError
            Before `init`.
        """
        if self._track is None:
            raise BoxError("nothing is tracked yet: call init with a frame and a box first")
        return self._track

    def init(self, frame: np.ndarray, box: str | Iterable[float], time: float = 0.0) -> None:
        """Start on a box, and forget all before.

        Parameters
        ----------
        frame : uint8 (h, w, 3) BGR, or (h, w) grey
        box : x, y, w, h in pixels: four numbers, or a text such as "120,80,64,48"
        time : seconds since the start of the video

        Raises
        ------
        BoxError
            For a box that is not in the frame, has no area, or is not a number.
        """
        detector = Detector(self.settings)
        first = detector.init(frame, Box.of(box), time)  # where the box is refused, all goes on as before
        self.detector = detector
        self.compressor = Compressor(self.settings)
        self.trainer = Trainer(self.settings)
        self._learn(*first)

    def update(self, frame: np.ndarray, time: float = 0.0) -> tuple[bool, Box | None]:
        """Find the object in the next frame, and learn from it.

        Returns
        -------
        whether it is there, and where: x, y, w, h in pixels, None where absent
        """
        _ = self.track
        self._learn(*self.detector.step(frame, time))
        return self.track.box is not None, self.track.box

    def _learn(self, track: Track, features: Features) -> None:
        self._track = track
        sample = self.compressor.take(features)
        if sample is not None:
            self.detector.adopt(self.trainer.train(sample))
            kalman.prepare()  # a later model brings the motion
