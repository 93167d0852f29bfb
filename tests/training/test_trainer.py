"""The trainer: scores that mean the same in every model."""

import dataclasses

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.coreset.compressor import Compressor
from catstream.detection.detector import Detector
from catstream.errors import ProtocolError
from catstream.features.pyramid import Pyramid
from catstream.training.trainer import Trainer
from catstream.wire.messages import Summary


@pytest.fixture(scope="module")
def sample():
    image = np.random.default_rng(3).integers(0, 256, (160, 200, 3), np.uint8)
    settings = Settings()
    _, features = Detector(settings).init(Pyramid(image), 1, 0.0, Box(60, 40, 50, 60))
    return Compressor(settings).take(0, features, 1)


def with_tree(sample, name, summary):
    return dataclasses.replace(sample, trees=sample.trees | {name: summary})


@pytest.mark.parametrize("classifier", ["joint", "least-squares", "one-class"])
def test_score_is_0_at_the_background_mean_and_1_at_the_object_mean(sample, classifier):
    model = Trainer(Settings(training={"classifier": classifier})).train(sample)
    assert model.weights @ sample.trees["background"].mean + model.bias == pytest.approx(0, abs=1e-4)
    assert model.weights @ sample.trees["object"].mean + model.bias == pytest.approx(1, abs=1e-4)
    assert (model.version, model.frame, model.weights.dtype) == (sample.version, sample.frame, np.float32)


def test_model_depends_on_its_own_sample_only(sample, rng):
    rows = rng.normal(size=sample.trees["extent"].rows.shape).astype(np.float32)
    other = with_tree(sample, "extent", dataclasses.replace(sample.trees["extent"], rows=rows))
    trainer = Trainer(Settings())

    def bits(model):
        return {name: each.tobytes() for name, each in model.heads.items()}, model.weights.tobytes(), model.biases

    for each in (sample, other, dataclasses.replace(other, object="anna"), other, sample):
        assert bits(trainer.train(each)) == bits(Trainer(Settings()).train(each))


def test_centres_give_a_motion(sample):
    centres = np.cumsum(np.random.default_rng(0).normal(size=(64, 2)), axis=0)
    assert Trainer(Settings()).train(dataclasses.replace(sample, centres=centres)).motion is not None
    assert Trainer(Settings()).train(sample).motion is None


def test_heads_predict_the_labels_of_cuts(sample, rng):
    x, labels = rng.normal(size=(40, len(sample.trees["object"].mean))), rng.uniform(size=(40, 3))
    rows = np.column_stack([x, np.ones(40), labels]).astype(np.float32)
    model = Trainer(Settings()).train(with_tree(sample, "extent", Summary(rows, rows.mean(axis=0), 40, (0,))))
    extent, size, aspect = labels.T
    together = x @ (model.weights + model.heads["extent"])
    np.testing.assert_allclose(together - together.mean(), extent - extent.mean(), atol=1e-2)
    for name, label in (("size", size), ("aspect", aspect)):
        np.testing.assert_allclose(x @ model.heads[name] + model.biases[name], label, atol=1e-2)


def test_object_like_the_background_is_rejected(sample):
    with pytest.raises(ProtocolError, match="choose another box"):
        Trainer(Settings()).train(with_tree(sample, "object", sample.trees["background"]))


def test_weights_that_score_the_object_lower_are_replaced(sample):
    """The rows of a tiny coreset may lie beyond the background, seen from the mean of all they stand for."""
    there, background = sample.trees["object"], sample.trees["background"].mean
    few = with_tree(sample, "object", dataclasses.replace(there, rows=2 * background - there.rows))
    model = Trainer(Settings(training={"classifier": "one-class"})).train(few)
    between = Trainer(Settings(training={"classifier": "least-squares"})).train(few)
    np.testing.assert_allclose(model.weights, between.weights, atol=1e-6)  # BLAS need not round the same twice
