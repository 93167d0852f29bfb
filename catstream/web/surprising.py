"""Selects the frames that the model predicted worst, of those for which a picture was received."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from catstream.heads import APPEARANCE
from catstream.messages import Features, Model, Preview, TrainingRows

__all__ = ["SurprisingFrame", "SurprisingFrames", "surprise"]

_Value = TypeVar("_Value")

_FRAMES = 12
_APART_SECONDS = 1.0  # minimum distance, because neighbouring frames are similar
_PENDING = 64  # number of frames whose picture or features are waited for


@dataclass(frozen=True, slots=True)
class SurprisingFrame:
    """One of the selected frames.

    frame, time  number and time stamp in the video
    surprise     its `surprise`
    preview      its picture
    """

    frame: int
    time: float
    surprise: float
    preview: Preview


def surprise(training: TrainingRows, model: Model) -> float:
    """Return the loss of a model on the training rows of a frame: the sum of weight * (score - label)^2."""
    errors = training.rows @ model.weights + np.float32(model.bias) - training.labels
    return float(training.weights @ errors**2)


class SurprisingFrames:
    """Keeps the few frames with the largest surprise, at least a second apart, in constant memory.

    A frame is measured once its features and its picture were received, with the newest model at that time. Frames
    before the first model are not measured.
    """

    def __init__(self) -> None:
        self.frames: list[SurprisingFrame] = []  #: in the order of the video
        self.measured = 0  #: number of measured frames
        self._models: dict[str, Model] = {}  # the newest of each object
        self._surprises: OrderedDict[int, tuple[float, float]] = OrderedDict()  # frame -> time, surprise
        self._pictures: OrderedDict[int, Preview] = OrderedDict()

    def adopt(self, model: Model) -> None:
        """Measure with this model from now on."""
        self._models[model.object] = model

    def add_features(self, features: Features) -> bool:
        """Add the features of a frame; return whether the selection has changed."""
        surprises = [
            surprise(training, model)
            for name, part in features.objects.items()
            if (model := self._models.get(name)) is not None
            and (training := part.training.get(APPEARANCE)) is not None
            and training.rows.shape[1] == len(model.weights)
        ]
        if not surprises:
            return False
        self._keep(self._surprises, features.frame, (features.time, max(surprises)))
        return self._match(features.frame)

    def add_preview(self, preview: Preview) -> bool:
        """Add the picture of a frame; return whether the selection has changed."""
        if not preview.boxes:
            return False
        self._keep(self._pictures, preview.frame, preview)
        return self._match(preview.frame)

    @staticmethod
    def _keep(pending: OrderedDict[int, _Value], frame: int, value: _Value) -> None:
        pending[frame] = value
        if len(pending) > _PENDING:
            pending.popitem(last=False)

    def _match(self, frame: int) -> bool:
        if frame not in self._surprises or frame not in self._pictures:
            return False
        self.measured += 1
        time, value = self._surprises.pop(frame)
        new = SurprisingFrame(frame, time, value, self._pictures.pop(frame))
        near = [other for other in self.frames if abs(other.time - time) < _APART_SECONDS]
        if any(other.surprise >= value for other in near):
            return False
        frames = sorted({*self.frames, new} - set(near), key=lambda one: one.surprise, reverse=True)[:_FRAMES]
        frames.sort(key=lambda one: one.frame)
        changed = frames != self.frames
        self.frames = frames
        return changed
