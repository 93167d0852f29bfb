"""Selects the frames that the model predicted worst, of those for which a picture was received."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features, Model, Preview, TrainingRows
from catstream.web.recent import Recent
from catstream.web.timing import APART_SECONDS

_FRAMES = 12
_PENDING = 64  # number of frames whose picture may still arrive


@dataclass(frozen=True, slots=True)
class SurprisingFrame:
    """One of the selected frames.

    frame, time  number and time stamp in the video
    object       name of the object
    surprise     `surprise` of the object's model
    preview      picture of the frame, with a box of the object
    """

    frame: int
    time: float
    object: str
    surprise: float
    preview: Preview


def surprise(training: TrainingRows, model: Model) -> float:
    """Return the loss of a model on the training rows of a frame: the sum of weight * (score - label)^2."""
    errors = training.rows @ model.weights + np.float32(model.bias) - training.labels
    return float(training.weights @ errors**2)


class SurprisingFrames:
    """Keeps the few frames with the largest surprise, those of one object at least a second apart, in constant memory.

    A frame is measured once its features and its picture were received, with the newest model of each object at that
    time. Frames before the first model of an object are not measured for it.

    Parameters
    ----------
    pictures : the last pictures that were received, by frame
    """

    def __init__(self, pictures: Mapping[int, Preview]) -> None:
        self.frames: list[SurprisingFrame] = []  #: in the order of the video
        self._measured: Counter[str] = Counter()
        self._surprises = Recent[int, tuple[float, dict[str, float]]](_PENDING)  # frame -> time, by object
        self._pictures = pictures

    @property
    def measured(self) -> int:
        """Number of measured frames, summed over the objects."""
        return self._measured.total()

    def drop(self, names: Iterable[str]) -> None:
        """Drop everything of these objects."""
        dropped = set(names)
        self.frames = [one for one in self.frames if one.object not in dropped]
        for name in dropped:
            del self._measured[name]
            for _, surprises in self._surprises.values():
                surprises.pop(name, None)

    def add_features(self, features: Features, models: Mapping[str, Model]) -> bool:
        """Add the features of a frame; return whether the selection has changed.

        Parameters
        ----------
        models : the newest model of each object that has one
        """
        surprises = {
            name: surprise(training, model)
            for name, part in features.objects.items()
            if (model := models.get(name)) is not None
            and (training := part.training.get(APPEARANCE)) is not None
            and training.rows.shape[1] == len(model.weights)
        }
        if not surprises:
            return False
        self._surprises[features.frame] = features.time, surprises
        return self.measure(features.frame)

    def measure(self, frame: int) -> bool:
        """Measure a frame if its features and its picture are here; return whether the selection has changed."""
        if frame not in self._surprises or frame not in self._pictures:
            return False
        time, surprises = self._surprises.pop(frame)
        preview, before = self._pictures[frame], self.frames
        for name in surprises.keys() & preview.boxes.keys():
            self._measured[name] += 1
            self._insert(SurprisingFrame(frame, time, name, surprises[name], preview))
        return self.frames != before

    def _insert(self, new: SurprisingFrame) -> None:
        """Add a frame to the selection, unless others are more surprising."""
        near = [one for one in self.frames if one.object == new.object and abs(one.time - new.time) < APART_SECONDS]
        if any(one.surprise >= new.surprise for one in near):
            return
        rest = [one for one in self.frames if one not in near]
        frames = sorted([*rest, new], key=lambda one: one.surprise, reverse=True)[:_FRAMES]
        self.frames = sorted(frames, key=lambda one: (one.frame, one.object))
