"""The tracker of one object in one process; `catstream.multi` tracks several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.client.saved_model import SavedModel
from catstream.multi import MultiTracker
from catstream.wire.messages import Track


class Tracker:
    """Tracks one object, frame by frame, with the interface of `cv2.Tracker`. It is a `MultiTracker` of one object.

    A frame is an array of shape (h, w, 3) in the order of OpenCV (blue, green, red), (h, w, 4) with transparency
    last (BGRA), or (h, w) or (h, w, 1) in grey; of uint8, uint16, or float from 0 to 1. All frames of an object have
    one size. Anything else is a `FrameError`, and the tracker stays as it was.

    Parameters
    ----------
    settings : Settings or mapping of str
        The settings that differ from the defaults.

    Examples
    --------
    >>> frame = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    >>> tracker = Tracker()
    >>> tracker.init(frame, (60, 40, 40, 40))
    >>> ok, box = tracker.update(np.roll(frame, 2, axis=1))
    >>> ok, box.overlap(Box(62, 40, 40, 40)) > 0.9
    (True, True)
    """

    def __init__(self, settings: Settings | Mapping[str, object] | None = None) -> None:
        self._objects = MultiTracker(settings)
        self.settings = self._objects.settings

    def __repr__(self) -> str:
        return repr(self._objects).replace("MultiTracker", "Tracker", 1)

    @property
    def track(self) -> Track:
        """The full result for the last frame: state, score, model version. BoxError before `init`."""
        return self._objects.tracks[UNNAMED]

    def init(self, frame: np.ndarray, box: str | Iterable[float], time: float = 0.0) -> None:
        """Start with the box of an object; a previous object is forgotten.

        Parameters
        ----------
        frame : ndarray
            The image, as above.
        box : str or four numbers
            x, y, w, h in pixels, for example `(120, 80, 64, 48)` or `"120,80,64,48"`.
        time : float
            Seconds since the start of the video.

        Raises
        ------
        BoxError
            For a box that is not in the frame, has no area, or is not a number.
        FrameError
            For an array that is not a frame, or a time that is not finite.
        """
        self._objects.init(frame, {UNNAMED: box}, time)

    def update(self, frame: np.ndarray, time: float = 0.0) -> tuple[bool, Box | None]:
        """Track the object in the next frame, and train its model on it. Raises the errors of `MultiTracker.update`.

        Returns
        -------
        found : bool
            Whether the object is present.
        box : Box or None
            Its box, x, y, w, h in pixels; None while it is absent.
        """
        track = self._objects.update(frame, time=time)[UNNAMED]
        return track.box is not None, track.box

    def saved_model(self) -> SavedModel:
        """The saved model of the object: see `MultiTracker.saved_model`."""
        return self._objects.saved_model()
