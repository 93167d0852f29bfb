"""The trainer: takes a sample of the coreset trees, and returns a model.

What `teaching.classifier` uses of the trees for the weights of the score:

    least-squares  the mean of the object; the mean and the rows of the background
    joint          the same, and the rows of the loss tree
    one-class      the rows of the object; the mean of the background

The means of object and background also scale the score, and the rows of the extent tree are used in each case.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from catstream.base.settings import Settings
from catstream.errors import ProtocolError
from catstream.messages.heads import BETWEEN_RIDGE, TREES, Head, Tree
from catstream.messages.kinds import Model, Motion, Sample
from catstream.numerics import ridge
from catstream.training.motion_em import learn_motion


class Trainer:
    """Trains a linear model of the object; the same sample gives the same model, bit for bit."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._regressions: dict[str, dict[str, ridge.Regression]] = {}  # of the last samples, by object and tree

    def train(self, sample: Sample) -> Model:
        """Train a model on a sample, in time that depends on n only.

        The score is scaled to 0 at the mean of the background and 1 at the mean of the object, so that the scores of
        all models are comparable. ProtocolError if object and background are the same in the sample.
        """
        self._regressions[sample.object] = self._regressions.pop(sample.object, {})
        if len(self._regressions) > self.settings.run.objects_most:  # the longest ago: it was forgotten
            del self._regressions[next(iter(self._regressions))]
        background_mean = sample.trees["background"].mean
        apart = sample.trees["object"].mean - background_mean
        # Very few rows may give a direction in which the object does not score higher: it is left out.
        useful = [scaled for each in self._directions(sample) if (scaled := _unit_contrast(each, apart)) is not None]
        weights = _unit_contrast(np.sum(useful, axis=0) if useful else _between(sample), apart)
        if weights is None:
            raise ProtocolError(
                f"sample {sample.version} has no difference between object and background: give another box"
            )
        motion = _motion(np.ascontiguousarray(sample.centres, np.float64).tobytes())
        bias = -float(weights @ background_mean)
        heads, biases = self._head_vectors(sample, weights)
        about = sample.object, sample.began, sample.network
        return Model(sample.version, sample.frame, weights, bias, motion, heads, biases, *about)

    def _directions(self, sample: Sample) -> list[np.ndarray]:
        settings = self.settings
        if settings.teaching.classifier == "one-class":
            from catstream.paper.one_class import one_class  # two seconds, for sklearn

            return [one_class(sample.trees["object"].rows, sample.trees["background"].mean)]
        if settings.teaching.classifier == "least-squares":
            return [_between(sample)]
        return [
            _between(sample),
            *(
                self._fitted(sample, tree, head)[0]
                for tree in TREES.values()
                for head in tree.heads
                if head.adds_to_score
            ),
        ]

    def _head_vectors(self, sample: Sample, weights: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, float]]:
        """The vectors of the heads that do not add to the score, and the biases of those that have one.

        The others are fitted to the residual of the labels, label - weights @ row: detection adds both products when it
        chooses size and aspect.
        """
        vectors, biases = {}, {}
        for tree in TREES.values():
            for head in tree.heads:
                if head.adds_to_score or tree.name not in sample.trees:
                    continue
                vectors[head.name], bias = self._fitted(sample, tree, head, None if head.has_bias else weights)
                if head.has_bias:
                    biases[head.name] = bias
        return vectors, biases

    def _fitted(
        self, sample: Sample, tree: Tree, head: Head, beside: np.ndarray | None = None
    ) -> tuple[np.ndarray, float]:
        """Weights and bias of a head; with `beside`, of what its label has beyond the product with these weights."""
        rows = sample.trees[tree.name].rows
        d = rows.shape[1] - tree.more_columns
        labels = rows[:, d + 1 + tree.heads.index(head)]
        if beside is not None:
            labels = labels - rows[:, :d] @ beside
        known, rows = self._regressions[sample.object], rows[:, : d + 1]
        if tree.name not in known or not np.array_equal(known[tree.name].rows, rows):  # not those of the last sample
            known[tree.name] = ridge.Regression(rows)
        return known[tree.name].fit(labels, head.penalty)


def _between(sample: Sample) -> np.ndarray:
    """Least squares of the object's mean against the background's mean and covariance.

    Its contrast is positive if the means differ.
    """
    background = sample.trees["background"]
    return ridge.between(background.rows, sample.trees["object"].mean - background.mean, BETWEEN_RIDGE)


def _unit_contrast(direction: np.ndarray, apart: np.ndarray) -> np.ndarray | None:
    """A direction scaled so that the means differ by 1 along it; None if the object's mean is not the higher one."""
    contrast = float(direction @ apart)
    return direction / np.float32(contrast) if contrast > 0 else None


@lru_cache(maxsize=256)  # all samples of a block of one object have the same centres
def _motion(centres: bytes) -> Motion | None:
    return learn_motion(np.frombuffer(centres, np.float64).reshape(-1, 2))
