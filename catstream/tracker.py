"""The tracker: detector, compressor and trainer in one process, one after the other.

The paper's three components in the order of its system figure: each frame is
searched with the last model, what it teaches is added to the coreset trees, and
a model is learned whenever they have grown. `catstream.pipeline` runs the same
three side by side.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Self

import numpy as np

from catstream import kalman, storage
from catstream.box import Box
from catstream.compression.compressor import Compressor
from catstream.detection.detector import Detector
from catstream.errors import BoxError, FrameError, ProtocolError, ServiceError
from catstream.features.cells import row_length
from catstream.image import as_bgr
from catstream.messages import Features, Model, Track
from catstream.packing import pack, unpack
from catstream.settings import Settings
from catstream.storage import Arrays, Metadata
from catstream.threads import one_thread
from catstream.training.trainer import Trainer
from catstream.wire.checks import check_message

__all__ = ["Tracker"]

_KIND = "tracker 2"  # and the version of what the file holds


class Tracker:
    """Follows one object, frame by frame; used like a `cv2.Tracker`.

    The same frames and settings give the same boxes, bit for bit. While a call computes, linear algebra in this
    process runs on one thread; what was set before holds again once it returns.

    A frame is an array of shape (h, w, 3) in the order of OpenCV (blue, green, red), (h, w, 4) with transparency
    last (BGRA), or (h, w) or (h, w, 1) in grey; of uint8, uint16, or float from 0 to 1. All frames of an object have
    one size. Anything else is a `FrameError`, and the tracker stays as it was.

    Parameters
    ----------
    settings : Settings or mapping of str
        Those that are not to have their default.

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
        self.settings = settings if isinstance(settings, Settings) else Settings().but(settings or {})
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
            For an array that is not a frame.
        """
        image, start = as_bgr(frame), Box.parse(box)
        compressor, trainer = Compressor(self.settings), Trainer(self.settings)
        detector = Detector(self.settings)
        detector.prepare()  # a library is held to one thread if it is there when a call begins
        with one_thread():
            first = detector.init(image, start, time)  # if the box is refused, nothing changes
            self.detector, self.compressor, self.trainer = detector, compressor, trainer
            self._size = image.shape[:2]
            self._learn(*first)

    def update(self, frame: np.ndarray, time: float = 0.0) -> tuple[bool, Box | None]:
        """Find the object in the next frame, and learn from it.

        Returns
        -------
        found : bool
            Whether the object is there.
        box : Box or None
            Where, x, y, w, h in pixels; None while it is absent.

        Raises
        ------
        BoxError
            Before `init`.
        FrameError
            For an array that is not a frame, or is of another size than those before.
        """
        _ = self.track
        image = as_bgr(frame)
        if image.shape[:2] != self._size:
            (height, width), (first_height, first_width) = image.shape[:2], self._size
            raise FrameError(
                f"this frame is {width}x{height} pixels, those before it {first_width}x{first_height}: "
                "resize it, or call init to begin anew"
            )
        with one_thread():
            self._learn(*self.detector.step(image, time))
        return self.track.box is not None, self.track.box

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all that was learned to one file, whole or not at all: `Tracker.load` continues from there.

        Raises
        ------
        BoxError
            Before `init`.
        ServiceError
            If it cannot be written.
        """
        track = self.track
        arrays, metadata = self.compressor.state()
        model, model_metadata = pack(self.detector.model, "model")
        start, start_metadata = self.detector.scm_state()
        whole: Metadata = {
            "kind": _KIND,
            "program": version("catstream"),
            "settings": self.settings.texts(),
            "size": list(self._size),
            "track": pack(track, "track")[1],
            "compressor": metadata,
            "model": model_metadata,
            "bootstrap": start_metadata,
        }
        try:
            storage.write(path, arrays | model | start, whole)
        except OSError as error:
            raise ServiceError(f"cannot write {str(path)!r} ({error}): give another file") from None

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """A tracker that continues where `save` was called, bit for bit.

        Raises
        ------
        ServiceError
            If there is no such file, or it cannot be read.
        ProtocolError
            If it is damaged, another file, or of a catstream with other features.
        """
        if not Path(path).is_file():
            raise ServiceError(f"there is no saved tracker {str(path)!r}: `Tracker.save` writes one")
        arrays, metadata = storage.read(path)
        try:
            if metadata.get("kind") != _KIND:
                raise ValueError(f"it is of kind {metadata.get('kind')!r}, not {_KIND!r}")
            return cls._of(arrays, metadata)
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise ProtocolError(f"{path} is not a saved tracker ({error}): `Tracker.save` writes one") from None

    @classmethod
    def _of(cls, arrays: Arrays, metadata: Metadata) -> Self:
        self = cls(Settings.from_values(metadata["settings"]))
        self.compressor = Compressor.from_state(arrays, metadata["compressor"], self.settings)
        self.trainer, self.detector = Trainer(self.settings), Detector(self.settings)
        model = unpack(Model, arrays, metadata["model"], "model")
        if len(model.weights) != row_length():
            raise ValueError(
                f"its model has {len(model.weights)} weights, the features of this catstream are {row_length()}: "
                f"catstream {metadata['program']} wrote it"
            )
        seq, state = self.compressor.seq, self.compressor.detector
        if state is None:
            raise ValueError("it does not say where the object was")
        self.detector.resume(seq, state, model)
        self.detector.resume_scm(arrays, metadata["bootstrap"])
        height, width = metadata["size"]
        self._size = int(height), int(width)
        self._track = unpack(Track, arrays, metadata["track"], "track")
        for message in (model, self._track):
            check_message(message)
        kalman.prepare()
        return self

    def _learn(self, track: Track, features: Features) -> None:
        self._track = track
        sample = self.compressor.take(features)
        if sample is not None:
            self.detector.adopt(self.trainer.train(sample))
        if track.frame >= self.settings.search.motion_frames // 2:
            kalman.prepare()  # so many more, and a sample brings the centres
