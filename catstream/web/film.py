"""The film: the frames that taught most, of those that were seen as pictures."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from catstream.heads import APPEARANCE
from catstream.messages import Features, Model, Preview, TrainingRows

__all__ = ["Film", "Shot", "surprise"]

_Kept = TypeVar("_Kept")

_SHOTS = 12
_APART_SECONDS = 1.0  # neighbours teach the same
_WAIT = 64  # frames whose picture or lesson may still come


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame of the film.

    frame, time  of the video
    taught       its `surprise`
    preview      its picture
    """

    frame: int
    time: float
    taught: float
    preview: Preview


def surprise(training: TrainingRows, model: Model) -> float:
    """What a frame taught: how wrong a model was about its rows.

    It is the weighted squared error, the frame's own part of the loss that training minimises:
    the sum of weight * (score - label)^2 over its rows.
    """
    wrong = training.rows @ model.weights + np.float32(model.bias) - training.labels
    return float(training.weights @ wrong**2)


class Film:
    """Holds the few frames that taught most, at least a second apart; constant memory.

    A frame counts once its lesson and its picture are both there, under the newest model by then. Before
    the first model nothing can be said of how wrong it was.
    """

    def __init__(self) -> None:
        self.shots: list[Shot] = []  #: in the order of the video
        self.frames = 0  #: how many were measured
        self._model: Model | None = None
        self._lessons: OrderedDict[int, tuple[float, float]] = OrderedDict()  # frame -> time, surprise
        self._pictures: OrderedDict[int, Preview] = OrderedDict()

    def adopt(self, model: Model) -> None:
        """Measure with a model from now on."""
        self._model = model

    def learn(self, features: Features) -> bool:
        """Take a frame's lesson; returns whether the film changed."""
        training = features.training.get(APPEARANCE)
        if self._model is None or training is None or training.rows.shape[1] != len(self._model.weights):
            return False
        self._keep(self._lessons, features.frame, (features.time, surprise(training, self._model)))
        return self._match(features.frame)

    def look(self, preview: Preview) -> bool:
        """Take a frame's picture; returns whether the film changed."""
        if preview.box is None:
            return False
        self._keep(self._pictures, preview.frame, preview)
        return self._match(preview.frame)

    @staticmethod
    def _keep(those: OrderedDict[int, _Kept], frame: int, what: _Kept) -> None:
        those[frame] = what
        if len(those) > _WAIT:
            those.popitem(last=False)

    def _match(self, frame: int) -> bool:
        if frame not in self._lessons or frame not in self._pictures:
            return False
        self.frames += 1
        time, taught = self._lessons.pop(frame)
        shot = Shot(frame, time, taught, self._pictures.pop(frame))
        near = [other for other in self.shots if abs(other.time - time) < _APART_SECONDS]
        if any(other.taught >= taught for other in near):
            return False
        shots = sorted({*self.shots, shot} - set(near), key=lambda one: one.taught, reverse=True)[:_SHOTS]
        shots.sort(key=lambda one: one.frame)
        changed = shots != self.shots
        self.shots = shots
        return changed
