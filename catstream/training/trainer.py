"""The trainer: a sample of the coreset trees in, a model out."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from catstream import ridge
from catstream.errors import ProtocolError
from catstream.messages import Model, Motion, Sample
from catstream.settings import Settings
from catstream.training.motion_em import learn_motion
from catstream.training.one_class import one_class

__all__ = ["Trainer"]


class Trainer:
    """Learns a linear model of the object; the same sample gives the same model."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def train(self, sample: Sample) -> Model:
        """Learn from a sample, in time that depends on n only.

        The score is scaled to be 0 at the mean of the background and 1 at the mean of the
        object, so that every model's scores mean the same.

        Raises
        ------
        ProtocolError
            For a sample in which object and background are the same.
        """
        mean, background_mean = sample.object.mean, sample.background.mean
        weights = np.zeros_like(mean)
        for direction in self._directions(sample):
            contrast = float(direction @ (mean - background_mean))
            if not contrast > 0:
                raise ProtocolError(
                    f"sample {sample.version} holds no difference between object and background: give another box"
                )
            weights += direction / np.float32(contrast)
        weights /= np.float32(weights @ (mean - background_mean))
        motion = _motion(np.ascontiguousarray(sample.centres, np.float64).tobytes())
        extent = None
        if sample.extent is not None:
            # What the score says of a cut already is taken off: the two are added up where size and aspect are chosen.
            rows = sample.extent.rows.copy()
            rows[:, -1] -= rows[:, :-2] @ weights
            extent = ridge.fit(rows, self.settings.extent_ridge)
        return Model(sample.version, sample.frame, weights, -float(weights @ background_mean), motion, extent)

    def _directions(self, sample: Sample) -> list[np.ndarray]:
        settings = self.settings
        if settings.classifier == "one-class":
            return [one_class(sample.object.rows, sample.background.mean)]
        means = ridge.between(sample.background.rows, sample.object.mean - sample.background.mean, settings.ridge)
        if settings.classifier == "least-squares":
            return [means]
        return [means, ridge.fit(sample.loss.rows, settings.loss_ridge)]


@lru_cache(maxsize=1)  # the same centres come with every sample of a block
def _motion(centres: bytes) -> Motion | None:
    return learn_motion(np.frombuffer(centres, np.float64).reshape(-1, 2))
