"""The trainer: a sample of the coreset trees in, a model out."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from catstream import ridge
from catstream.errors import ProtocolError
from catstream.messages import Model, Motion, Sample
from catstream.paper.one_class import one_class
from catstream.settings import Settings
from catstream.training.motion_em import learn_motion

__all__ = ["Trainer"]


class Trainer:
    """Learns a linear model of the object; the same sample gives the same model."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        ridge.prepare()  # now, and not with the first sample, whose model is waited for

    def train(self, sample: Sample) -> Model:
        """Learn from a sample, in time that depends on n only.

        The score is scaled to be 0 at the mean of the background and 1 at the mean of the
        object, so that every model's scores mean the same.

        Raises
        ------
        ProtocolError
            For a sample in which object and background are the same.
        """
        background_mean = sample.background.mean
        apart = sample.object.mean - background_mean
        # A direction in which the object scores no higher, as very few rows may give one, is worth nothing.
        useful = [scaled for each in self._directions(sample) if (scaled := _unit_contrast(each, apart)) is not None]
        weights = _unit_contrast(np.sum(useful, axis=0) if useful else _between(sample, self.settings), apart)
        if weights is None:
            raise ProtocolError(
                f"sample {sample.version} holds no difference between object and background: give another box"
            )
        motion = _motion(np.ascontiguousarray(sample.centres, np.float64).tobytes())
        extent = None
        if sample.extent is not None:
            # What the score says of a cut already is taken off: the two are added up where size and aspect are chosen.
            rows = sample.extent.rows.copy()
            rows[:, -1] -= rows[:, :-2] @ weights
            extent = ridge.fit(rows, self.settings.teaching.extent_ridge)
        return Model(sample.version, sample.frame, weights, -float(weights @ background_mean), motion, extent)

    def _directions(self, sample: Sample) -> list[np.ndarray]:
        settings = self.settings
        if settings.teaching.classifier == "one-class":
            return [one_class(sample.object.rows, sample.background.mean)]
        if settings.teaching.classifier == "least-squares":
            return [_between(sample, settings)]
        return [_between(sample, settings), ridge.fit(sample.loss.rows, settings.teaching.loss_ridge)]


def _between(sample: Sample, settings: Settings) -> np.ndarray:
    """Least squares of the two trees: its contrast is positive wherever the means differ."""
    return ridge.between(sample.background.rows, sample.object.mean - sample.background.mean, settings.teaching.ridge)


def _unit_contrast(direction: np.ndarray, apart: np.ndarray) -> np.ndarray | None:
    """Scaled so that the means differ by 1 along it; None where the object's is not the higher one."""
    contrast = float(direction @ apart)
    return direction / np.float32(contrast) if contrast > 0 else None


@lru_cache(maxsize=1)  # the same centres come with every sample of a block
def _motion(centres: bytes) -> Motion | None:
    return learn_motion(np.frombuffer(centres, np.float64).reshape(-1, 2))
