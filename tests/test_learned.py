"""What was learned, in a file: as it was, or not at all; and trees that go on from it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from catstream.box import Box
from catstream.compression.compressor import Compressor
from catstream.compression.tree import CoresetTree
from catstream.errors import ProtocolError, ServiceError
from catstream.heads import APPEARANCE, EXTENT
from catstream.learned import Learned
from catstream.messages import Features, Model, Motion, TrainingRows
from catstream.settings import Settings

SIZE, WIDTH = 8, 20


def features(rng, seq, begins=False):
    """What a frame teaches: rows of an object around 1, and of a background around -1."""
    labels = np.repeat(np.float32([1, 0]), 4)
    rows = rng.normal(scale=0.2, size=(8, WIDTH)).astype(np.float32) + np.where(labels[:, None], 1, -1)
    box = Box(1.0, 2.0, 30.0, 40.0)
    training = {APPEARANCE: TrainingRows.labelled(rows, labels), EXTENT: TrainingRows.labelled(rows[:4], 1)}
    return Features(seq, seq - 1, seq / 25, box, training, None, begins)


@pytest.fixture
def compressor(rng):
    """One that has seen a while."""
    compressor = Compressor(Settings(coreset={"size": SIZE}))
    for seq in range(1, 101):
        compressor.take(features(rng, seq))
    return compressor


@pytest.fixture
def learned(compressor, rng):
    sample = compressor.last_sample
    motion = Motion(np.eye(4), np.eye(2))
    weights = rng.normal(size=WIDTH).astype(np.float32)
    return Learned(
        Model(sample.version, sample.frame, weights, -0.25, motion, {EXTENT: weights}),
        sample,
        Box(1.0, 2.0, 30.0, 40.0),
    )


def test_a_saved_model_is_loaded_bit_for_bit_and_frames_start_at_zero(learned, tmp_path):
    learned.save(tmp_path / "one")
    read = Learned.load(tmp_path / "one")
    anew = (dataclasses.replace(part, frame=0) for part in (learned.model, learned.sample))
    np.testing.assert_equal(dataclasses.asdict(read), dataclasses.asdict(Learned(*anew, learned.box)))


@pytest.mark.parametrize("share", [0, 0.3, 0.99])
def test_an_incomplete_file_is_an_error(learned, tmp_path, share):
    learned.save(tmp_path / "one")
    whole = (tmp_path / "one").read_bytes()
    (tmp_path / "one").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ProtocolError, match="not an undamaged file"):
        Learned.load(tmp_path / "one")


def test_a_file_of_another_kind_is_an_error(compressor, tmp_path):
    compressor.save(tmp_path / "one")
    with pytest.raises(ProtocolError, match="not a saved model"):
        Learned.load(tmp_path / "one")


def test_an_unwritable_file_is_an_error_and_leaves_nothing(learned, tmp_path):
    with pytest.raises(ServiceError, match="cannot write"):
        learned.save(tmp_path / "none" / "one")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [SIZE // 2, SIZE, 2 * SIZE])
def test_a_tree_of_a_sample_stands_for_as_many_rows_with_the_same_mean(compressor, size):
    tree = compressor.trees["object"]
    summary = tree.sample()
    other = CoresetTree.from_summary(summary, size)
    assert summary.count / 2 < other.rows_seen <= summary.count
    np.testing.assert_allclose(other.sum / other.rows_seen, tree.sum / tree.rows_seen, rtol=1e-5)
    directions = np.linalg.qr(np.random.default_rng(3).normal(size=(WIDTH, 3)))[0]
    ours, theirs = (
        sum(float(np.sum((node.rows @ directions) ** 2)) for node in each.nodes) / each.rows_seen
        for each in (other, tree)
    )
    assert ours == pytest.approx(theirs, rel=0.2)
    CoresetTree.from_state(*other.state())


def test_a_compressor_continues_from_a_sample_with_its_version_and_its_weight(learned, rng, tmp_path):
    learned.save(tmp_path / "one")
    compressor = Compressor.from_sample(Learned.load(tmp_path / "one").sample, Settings(coreset={"size": SIZE}))
    assert compressor.sampled == learned.sample.version
    samples = [sample for seq in range(1, 30) if (sample := compressor.take(features(rng, seq)))]
    assert [sample.version for sample in samples] == [learned.sample.version + 1 + i for i in range(len(samples))]
    assert samples[-1].trees["object"].count > learned.sample.trees["object"].count / 2


def test_a_new_object_keeps_nothing_of_the_previous_one_except_the_versions(compressor, rng):
    version, fresh = compressor.version, Compressor(Settings(coreset={"size": SIZE}))
    stream = [features(rng, seq, begins=seq == 101) for seq in range(101, 140)]
    ours = [compressor.take(message) for message in stream]
    theirs = [fresh.take(dataclasses.replace(message, seq=message.seq - 100)) for message in stream]
    for one, other in zip(ours, theirs, strict=True):
        if one is not None:
            np.testing.assert_equal(
                dataclasses.asdict(one), dataclasses.asdict(dataclasses.replace(other, version=other.version + version))
            )
    assert [one is None for one in ours] == [other is None for other in theirs]
    assert ours[-1] is not None or any(ours)


def test_until_its_first_sample_another_object_has_none(compressor, rng):
    assert compressor.sampled
    compressor.take(features(rng, 101, begins=True))
    assert compressor.sampled == 0
