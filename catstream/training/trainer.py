"""The trainer: a sample of the coreset trees in, a model out."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from catstream import ridge
from catstream.errors import ProtocolError
from catstream.heads import BACKGROUND, HEADS
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
        background_mean = sample.trees["background"].mean
        apart = sample.trees["object"].mean - background_mean
        # A direction in which the object scores no higher, as very few rows may give one, is worth nothing.
        useful = [scaled for each in self._directions(sample) if (scaled := _unit_contrast(each, apart)) is not None]
        weights = _unit_contrast(np.sum(useful, axis=0) if useful else _between(sample), apart)
        if weights is None:
            raise ProtocolError(
                f"sample {sample.version} holds no difference between object and background: give another box"
            )
        motion = _motion(np.ascontiguousarray(sample.centres, np.float64).tobytes())
        bias = -float(weights @ background_mean)
        return Model(sample.version, sample.frame, weights, bias, motion, _beside_the_score(sample, weights))

    def _directions(self, sample: Sample) -> list[np.ndarray]:
        settings = self.settings
        if settings.teaching.classifier == "one-class":
            return [one_class(sample.trees["object"].rows, sample.trees["background"].mean)]
        if settings.teaching.classifier == "least-squares":
            return [_between(sample)]
        fitted = [head for head in HEADS.values() if head.adds_to_score and head.label is None]
        return [_between(sample), *(ridge.fit(sample.trees[head.name].rows, head.ridge) for head in fitted)]


def _between(sample: Sample) -> np.ndarray:
    """Least squares of the object's tree against the background's: the contrast is positive if the means differ."""
    background = sample.trees["background"]
    return ridge.between(background.rows, sample.trees["object"].mean - background.mean, BACKGROUND.ridge)


def _beside_the_score(sample: Sample, weights: np.ndarray) -> dict[str, np.ndarray]:
    """The vectors of the heads that do not add to the score, each fitted to what the score leaves of the labels.

    Detection adds the two up where it chooses size and aspect.
    """
    vectors = {}
    for name, head in HEADS.items():
        if not head.adds_to_score and name in sample.trees:
            rows = sample.trees[name].rows.copy()
            rows[:, -1] -= rows[:, :-2] @ weights
            vectors[name] = ridge.fit(rows, head.ridge)
    return vectors


def _unit_contrast(direction: np.ndarray, apart: np.ndarray) -> np.ndarray | None:
    """Scaled so that the means differ by 1 along it; None where the object's is not the higher one."""
    contrast = float(direction @ apart)
    return direction / np.float32(contrast) if contrast > 0 else None


@lru_cache(maxsize=1)  # the same centres come with every sample of a block
def _motion(centres: bytes) -> Motion | None:
    return learn_motion(np.frombuffer(centres, np.float64).reshape(-1, 2))
