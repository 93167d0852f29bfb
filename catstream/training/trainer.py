"""The trainer: trains a model on a sample of the coreset trees.

The classifiers of `training.classifier` compute the weights of the score from these parts of the trees:

    least-squares  the mean of the object; the mean and the rows of the background
    joint          as least-squares, and the rows of the loss tree
    one-class      the rows of the object; the mean of the background

All of them scale the score by the means of object and background, and use the rows of the extent tree.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from catstream.base import ridge
from catstream.base.settings import Settings
from catstream.errors import ProtocolError
from catstream.training.motion_em import learn_motion
from catstream.wire.heads import DISCRIMINANT_RIDGE, TREES, Head, Tree
from catstream.wire.messages import Model, Motion, Sample


class Trainer:
    """Trains a linear model of the object; the same sample gives the same model, bit for bit."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._regressions: dict[str, dict[str, ridge.Regression]] = {}  # of the last sample, by object and tree

    def train(self, sample: Sample) -> Model:
        """Train a model on a sample, in time that depends on n only.

        The score is scaled to 0 at the mean of the background and 1 at the mean of the object, so that the scores of
        all models are comparable. ProtocolError if object and background have the same mean in the sample.
        """
        self._regressions[sample.object] = self._regressions.pop(sample.object, {})
        if len(self._regressions) > self.settings.run.max_objects:  # drop the object that was trained least recently
            del self._regressions[next(iter(self._regressions))]
        background_mean = sample.trees["background"].mean
        difference = sample.trees["object"].mean - background_mean
        # With very few rows, the object may not score higher along a direction. Such a direction is not used.
        scaled = [_unit_contrast(direction, difference) for direction in self._directions(sample)]
        useful = [direction for direction in scaled if direction is not None]
        weights = _unit_contrast(np.sum(useful, axis=0) if useful else _discriminant(sample), difference)
        if weights is None:
            raise ProtocolError(
                f"object and background have the same mean in sample {sample.version}: choose another box"
            )
        motion = _motion(np.ascontiguousarray(sample.centres, np.float64).tobytes())
        bias = -float(weights @ background_mean)
        heads, biases = self._head_vectors(sample, weights)
        return Model(sample.version, sample.frame, weights, bias, motion, heads, biases, sample.object, sample.began)

    def _directions(self, sample: Sample) -> list[np.ndarray]:
        settings = self.settings
        if settings.training.classifier == "one-class":
            from catstream.training.one_class import one_class  # two seconds, for sklearn

            return [one_class(sample.trees["object"].rows, sample.trees["background"].mean)]
        if settings.training.classifier == "least-squares":
            return [_discriminant(sample)]
        return [
            _discriminant(sample),
            *(
                self._fitted(sample, tree, head)[0]
                for tree in TREES.values()
                for head in tree.heads
                if head.adds_to_score
            ),
        ]

    def _head_vectors(self, sample: Sample, weights: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, float]]:
        """The vectors and the biases of the heads that do not add to the score.

        A head without a bias is fitted to the residual of its labels, label - weights @ row, because detection adds
        both products when it selects size and aspect ratio.
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
        self, sample: Sample, tree: Tree, head: Head, score_weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, float]:
        """Weights and bias of a head; with `score_weights`, fitted to the residual of its labels."""
        rows = sample.trees[tree.name].rows
        d = rows.shape[1] - tree.more_columns
        labels = rows[:, d + 1 + tree.heads.index(head)]
        if score_weights is not None:
            labels = labels - rows[:, :d] @ score_weights
        regressions = self._regressions[sample.object]
        inputs = rows[:, : d + 1]
        if tree.name not in regressions or not np.array_equal(regressions[tree.name].rows, inputs):
            regressions[tree.name] = ridge.Regression(inputs)
        return regressions[tree.name].fit(labels, head.penalty)


def _discriminant(sample: Sample) -> np.ndarray:
    """The linear discriminant of object and background; its contrast is positive if the means differ."""
    background = sample.trees["background"]
    return ridge.discriminant(background.rows, sample.trees["object"].mean - background.mean, DISCRIMINANT_RIDGE)


def _unit_contrast(direction: np.ndarray, difference: np.ndarray) -> np.ndarray | None:
    """Scale a direction so that the means differ by 1 along it; None if the object does not score higher."""
    contrast = float(direction @ difference)
    return direction / np.float32(contrast) if contrast > 0 else None


@lru_cache(maxsize=256)  # all samples of a block of one object have the same centres
def _motion(centres: bytes) -> Motion | None:
    return learn_motion(np.frombuffer(centres, np.float64).reshape(-1, 2))
