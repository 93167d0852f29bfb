"""Several objects in one process: detectors, compressors and trainer, one after the other.

These are the three components of the paper in the order of its system figure: in every frame, the objects are searched
with their newest models, their training rows are inserted into their coreset trees, and a model is trained whenever
these have grown. `catstream.pipeline` runs the same components as three processes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType

import numpy as np

from catstream.base.names import UNNAMED, Boxes, boxes_by_name, by_name, check_count, check_name
from catstream.base.settings import Settings
from catstream.base.text import listed
from catstream.base.threads import one_thread
from catstream.client.saved_model import SavedModel
from catstream.coreset.compressor import Compressor
from catstream.coreset.forest import Forest
from catstream.detection.objects import Detectors
from catstream.errors import BoxError, CatstreamError, FrameError, ObjectError
from catstream.features.pyramid import Pyramid
from catstream.training import motion_em
from catstream.training.trainer import Trainer
from catstream.video.frames import as_bgr
from catstream.wire.messages import Features, Track, Tracks


class MultiTracker:
    """Tracks several objects, frame by frame.

    The same frames and settings give the same boxes, bit for bit, as a `catstream.Pipeline` in lockstep. During a call,
    linear algebra in this process runs on one thread; the previous number is restored when it returns. One thread at a
    time may call a tracker; trackers in several threads are independent.

    A frame is an array as `catstream.Tracker` takes it.

    Parameters
    ----------
    settings : Settings or mapping of str
        The settings that differ from the defaults.

    Examples
    --------
    >>> from catstream.base.box import Box
    >>> frame = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    >>> tracker = MultiTracker()
    >>> tracker.init(frame, {"anna": (60, 40, 40, 40), "ben": (10, 70, 30, 30)})
    >>> tracks = tracker.update(np.roll(frame, 2, axis=1))
    >>> tracks["anna"].box.overlap(Box(62, 40, 40, 40)) > 0.9
    True
    """

    def __init__(self, settings: Settings | Mapping[str, object] | None = None) -> None:
        self.settings = Settings().replace(settings)
        self._tracks: dict[str, Track] | None = None
        self._is_busy = False

    def __repr__(self) -> str:
        if self._tracks is None:
            return "<catstream.MultiTracker, before init>"
        frame = max((track.frame for track in self._tracks.values()), default=0)
        states = ", ".join(f"{name or 'the object'} {track.state}" for name, track in self._tracks.items())
        return f"<catstream.MultiTracker, at frame {frame}: {states or 'no object'}>"

    @property
    def tracks(self) -> dict[str, Track]:
        """The result of each object for the last frame, by name.

        Raises
        ------
        BoxError
            Before `init`.
        """
        if self._tracks is None:
            raise BoxError("nothing is tracked yet: call init with a frame and a box first")
        return dict(self._tracks)

    def init(self, frame: np.ndarray, boxes: Boxes, time: float = 0.0) -> None:
        """Start with the boxes of objects, and forget everything before.

        The first call of a program imports filterpy, most of a second, so that no update waits for it.

        Parameters
        ----------
        frame : ndarray
            The image.
        boxes : mapping of str to boxes
            The box of each object by its name: x, y, w, h in pixels, for example `{"anna": (120, 80, 64, 48)}`.
        time : float
            Seconds since the start of the video.

        Raises
        ------
        BoxError
            For a box that is not in the frame, has no area, or is not a number.
        FrameError
            For an array that is not a frame, or a time that is not finite.
        ObjectError
            For a name that is not valid, no object, or too many objects.
        """
        image, boxes, time = as_bgr(frame), boxes_by_name(boxes), _seconds(time)
        if not boxes:
            raise ObjectError("no object to track: pass a box for at least one name")
        check_count(len(boxes), self.settings.run.max_objects)
        motion_em.prepare()
        detectors, forest, trainer = Detectors(self.settings), Forest(self.settings), Trainer(self.settings)
        with self._exclusive(), one_thread():
            pyramid = Pyramid(image)
            results = detectors.begin_all(boxes, pyramid, time)
            # After an error, the tracker is unchanged.
            self.detectors, self.forest, self.trainer, self._size = detectors, forest, trainer, image.shape[:2]
            self._train(*detectors.step(pyramid, time, results))

    def update(
        self,
        frame: np.ndarray,
        *,
        time: float = 0.0,
        begin: Boxes | None = None,
        search: Mapping[str, SavedModel | str | os.PathLike[str]] | None = None,
    ) -> dict[str, Track]:
        """Track the objects in the next frame, and train their models on it.

        Parameters
        ----------
        time : float
            Seconds since the start of the video.
        begin : mapping of str to boxes
            The boxes of objects that begin in this frame. An object of the same name is forgotten. After an error
            in one box, no object has begun, and the frame is not counted.
        search : mapping of str to SavedModel or path
            Saved models of objects to search for from this frame on, by name. An object is absent until its first
            detection, and training continues from its saved model. An object of the same name is forgotten.

        Returns
        -------
        the track of each object, by name

        Raises
        ------
        BoxError
            Before `init`, or for a box as there.
        FrameError
            For an array that is not a frame, a frame of another size than the first one, or a time that is not finite.
        ObjectError
            For a name as in `init`, or a name with both a box and a saved model.
        SettingsError
            If the settings differ from the settings of a saved model.
        ServiceError, ProtocolError
            If the file of a saved model cannot be read, or is not one.
        """
        _ = self.tracks
        image, boxes, time = as_bgr(frame), boxes_by_name({} if begin is None else begin), _seconds(time)
        models = {
            name: model if isinstance(model, SavedModel) else SavedModel.load(model)
            for name, model in by_name(search or {}).items()
        }
        if both := models.keys() & boxes.keys():
            raise ObjectError(f"{listed(sorted(both))}: a box and a saved model of one object are mutually exclusive")
        check_count(len(self.detectors.detectors.keys() | boxes.keys() | models.keys()), self.settings.run.max_objects)
        compressors = {name: saved.compressor(self.settings, name) for name, saved in models.items()}
        if image.shape[:2] != self._size:
            (height, width), (first_height, first_width) = image.shape[:2], self._size
            raise FrameError(
                f"this frame is {width}x{height} pixels, the first one {first_width}x{first_height}: "
                "resize it, or call init to start again"
            )
        with self._exclusive(), one_thread():
            self.detectors.seq = self.forest.seq  # repeats a frame whose update was interrupted, for example by Ctrl-C
            pyramid = Pyramid(image)
            results = self.detectors.begin_all(boxes, pyramid, time)
            for name, saved in models.items():
                self.detectors.seek(name, saved.model, saved.box, saved.similarity())
            self._train(*self.detectors.step(pyramid, time, results), compressors)
        return self.tracks

    def forget(self, name: str) -> None:
        """Stop tracking an object; its trees are dropped with the next frame.

        Raises
        ------
        BoxError
            Before `init`.
        ObjectError
            If there is no object of this name.
        """
        _ = self.tracks
        self.detectors.forget(check_name(name))

    def saved_model(self, name: str = UNNAMED) -> SavedModel:
        """The saved model of an object, to be used in another video.

        Raises
        ------
        BoxError
            Before `init`.
        ObjectError
            If there is no object of this name.
        ServiceError
            If there are too few training frames.
        """
        _ = self.tracks
        name = check_name(name)
        if name not in self.forest.compressors:
            raise ObjectError(f"there is no object {name!r}: the objects are {listed(self.forest.compressors)}")
        return SavedModel.of(self.forest.compressors[name], self.settings)

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        """A block of one thread at a time; CatstreamError if another thread is in it."""
        if self._is_busy:
            raise CatstreamError("another thread uses this tracker: use one tracker in each thread, or a lock")
        self._is_busy = True
        try:
            yield
        finally:
            self._is_busy = False

    def _train(
        self, tracks: Tracks, features: Features, continued: Mapping[str, Compressor] = MappingProxyType({})
    ) -> None:
        self._tracks = tracks.tracks
        for sample in self.forest.take(features, continued):
            self.detectors.adopt(self.trainer.train(sample))


def _seconds(time: float) -> float:
    """The time of a frame as a Python float."""
    try:
        seconds = float(time)
    except (TypeError, ValueError):
        seconds = math.nan
    if not math.isfinite(seconds):
        raise FrameError(f"the time of a frame is a finite number of seconds, got {time!r:.80}: omit it if unknown")
    return seconds
