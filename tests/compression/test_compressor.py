"""Laws of the compressor: each message counts once, in order, and a restart changes nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal

from catstream import storage
from catstream.box import Box, Window
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.compression.compressor import Compressor
from catstream.compression.tree import TREES, CoresetTree
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.heads import APPEARANCE, EXTENT, HEADS
from catstream.messages import DetectorState, Features, Motion, Sample, TrainingRows
from catstream.settings import Settings

WIDTH = 20


@pytest.fixture(params=TREES)
def settings(request: pytest.FixtureRequest) -> Settings:
    coreset = {"size": 8, "sample_interval": 4, "reduction": request.param}
    return Settings(coreset=coreset, search={"motion_frames": 10})


@pytest.fixture
def messages(rng) -> Iterator[Features]:
    """Features of frames without end: two rows of the object, three of the background, one near miss."""

    def stream() -> Iterator[Features]:
        for frame in range(10_000):
            rows = rng.normal(size=(6, WIDTH)).astype(np.float32)
            labels = np.array([1, 1, 0, 0, 0, 0.5], np.float32)
            weights = np.array([4, 4, 1, 1, 1, 1], np.float32)
            box = Box(frame, 10, 20, 30) if frame % 5 else None
            training = {
                APPEARANCE: TrainingRows(rows, labels, weights),
                EXTENT: TrainingRows.labelled(rows[:3], labels[:3]),
            }
            yield Features(frame + 1, frame, frame / 25, box, training)

    return stream()


def without_rows(message):
    return dataclasses.replace(message, training={})


def take(compressor: Compressor, messages: Iterator[Features], count: int) -> list[Sample]:
    samples = (compressor.take(next(messages)) for _ in range(count))
    return [sample for sample in samples if sample is not None]


def assert_same(sample: Sample, other: Sample) -> None:
    assert (sample.version, sample.frame) == (other.version, other.frame)
    assert_array_equal(sample.centres, other.centres)
    assert sample.trees.keys() == other.trees.keys()
    for name, summary in sample.trees.items():
        expected = other.trees[name]
        assert_array_equal(summary.rows, expected.rows)
        assert_array_equal(summary.mean, expected.mean)
        assert (summary.count, summary.levels) == (expected.count, expected.levels)


def test_each_row_is_inserted_into_the_tree_of_its_label(settings, messages):
    compressor = Compressor(settings)
    sample = take(compressor, messages, 60)[-1]
    frames = sample.frame + 1
    rows = {(APPEARANCE, 1.0): 2, (APPEARANCE, 0.0): 3, (APPEARANCE, None): 6, (EXTENT, None): 3}
    counts = {name: frames * rows[head.group, head.label] for name, head in HEADS.items()}
    assert {name: tree.count for name, tree in sample.trees.items()} == counts


def test_rows_of_the_loss_tree_give_the_loss_of_any_model(settings, messages, rng):
    """||A [w; b; -1]||^2 is the weighted squared error, and C keeps it within the energy dropped."""
    compressor, seen = Compressor(settings), [next(messages) for _ in range(60)]
    for message in seen:
        compressor.take(message)
    trained = [message.training[APPEARANCE] for message in seen]
    tree = compressor.trees["loss"]
    kept = np.vstack([*(node.rows for node in tree.nodes), tree.pending]).astype(np.float64)
    for _ in range(10):
        model = rng.normal(size=WIDTH + 2)
        model[-1] = -1
        loss = sum(float(m.weights @ (m.rows @ model[:-2] + model[-2] - m.labels) ** 2) for m in trained)
        approximate = float(np.sum((kept @ model) ** 2))
        assert loss - tree.dropped_energy * (model @ model) <= approximate <= loss * (1 + 1e-5)


def test_trees_of_another_class_stay_when_another_object_begins(settings, messages):
    class Other(CoresetTree):
        pass

    compressor = Compressor(settings, Other)
    compressor.take(dataclasses.replace(next(messages), begins=True))
    assert {type(tree) for tree in compressor.trees.values()} == {Other}


def test_a_message_stored_already_is_ignored(settings, messages):
    compressor, message = Compressor(settings), next(messages)
    compressor.take(message)
    before = compressor.counters()
    assert compressor.take(message) is None
    assert compressor.counters() == before


def test_a_missing_message_is_an_error_and_is_still_accepted_later(settings, messages):
    compressor, (first, second) = Compressor(settings), (next(messages), next(messages))
    with pytest.raises(ProtocolError, match="features 2 came after 0: 1 are missing"):
        compressor.take(second)
    compressor.take(first)
    compressor.take(second)
    assert compressor.seq == 2


def test_rows_of_another_length_are_rejected_and_nothing_is_stored(settings, messages):
    compressor, (first, second) = Compressor(settings), (next(messages), next(messages))
    compressor.take(first)
    before = compressor.counters()
    with pytest.raises(ProtocolError, match="same settings"):
        compressor.take(
            dataclasses.replace(second, training={EXTENT: TrainingRows.labelled(np.ones((3, WIDTH - 1)), 1)})
        )
    assert compressor.counters() == before
    compressor.take(second)


def test_frames_that_teach_nothing_count_as_seen(settings, messages):
    compressor, message = Compressor(settings), next(messages)
    compressor.take(without_rows(message))
    assert (compressor.seq, compressor.frame, compressor.counters()["rows"]) == (1, 0, 0)


def test_versions_count_up_and_samples_keep_their_distance(settings, messages):
    samples = take(Compressor(settings), messages, 400)
    assert [sample.version for sample in samples] == list(range(1, len(samples) + 1))
    apart = np.diff([sample.frame for sample in samples])
    assert apart[0] < settings.coreset.sample_interval, "sooner while the trees are small"
    assert (apart[len(apart) // 2 :] >= settings.coreset.sample_interval).all()


def test_a_sample_is_made_only_if_a_leaf_is_new(settings, messages):
    compressor, idle = Compressor(settings), 0
    take(compressor, messages, 40)
    for _ in range(40):
        idle += compressor.take(without_rows(next(messages))) is not None
    assert idle <= 1


def test_centres_are_sent_in_whole_blocks_with_nan_for_absent_objects(settings, messages):
    samples = take(Compressor(settings), messages, 60)
    for sample in samples:
        blocks = (sample.frame + 1) // settings.search.motion_frames
        assert sample.centres.shape == ((settings.search.motion_frames if blocks else 0), 2)
        for offset, centre in enumerate(sample.centres):
            frame = (blocks - 1) * settings.search.motion_frames + offset
            assert_allclose(centre, (frame + 10, 25) if frame % 5 else (np.nan, np.nan))


@pytest.mark.parametrize("count", [0, 1, 37])
def test_a_saved_compressor_continues_bit_for_bit(settings, messages, count, tmp_path):
    compressor = Compressor(settings)
    take(compressor, messages, count)
    compressor.save(tmp_path / "state")
    loaded = Compressor.load(tmp_path / "state", settings)
    assert loaded.counters() == compressor.counters()
    assert loaded.box == compressor.box
    for _ in range(40):
        message = next(messages)
        sample, again = compressor.take(message), loaded.take(message)
        assert (sample is None) == (again is None)
        if sample is not None:
            assert_same(sample, again)


def test_the_last_sample_can_be_had_again_though_the_trees_have_grown(settings, messages, tmp_path):
    compressor, samples = Compressor(settings), []
    assert compressor.last_sample is None
    while len(samples) < 3:
        samples += take(compressor, messages, 1)
    assert not take(compressor, messages, 2)
    compressor.save(tmp_path / "state")
    assert_same(Compressor.load(tmp_path / "state", settings).last_sample, samples[-1])


@pytest.mark.parametrize("moving", [False, True])
def test_the_detector_state_of_the_last_message_is_stored_bit_for_bit(settings, messages, moving, rng, tmp_path):
    motion, centre = (Motion(rng.normal(size=(4, 4)), rng.normal(size=(2, 2))), rng.normal(size=(5, 4)))
    detector = DetectorState(7, "lost", *(Window(*rng.random(4)) for _ in range(3)), False, 2)
    if moving:
        detector = dataclasses.replace(detector, motion=motion, centre=centre, colour_centroid=rng.random(6))
    compressor = Compressor(settings)
    compressor.take(dataclasses.replace(next(messages), detector=detector))
    compressor.save(tmp_path / "state")
    loaded = Compressor.load(tmp_path / "state", settings).detector
    assert_equal(dataclasses.asdict(loaded), dataclasses.asdict(detector))


def test_memory_is_flat_between_doublings(settings, messages):
    compressor = Compressor(settings)
    take(compressor, messages, 256)
    small = compressor.counters()["bytes"]
    take(compressor, messages, 256 * 15)
    assert compressor.counters()["bytes"] < 2.5 * small


@pytest.mark.parametrize("share", [0, 0.2, 0.9])
def test_an_incomplete_state_is_rejected(settings, messages, share, tmp_path):
    compressor, path = Compressor(settings), tmp_path / "state"
    take(compressor, messages, 37)
    compressor.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ProtocolError, match="use an older copy"):
        Compressor.load(path, settings)


@pytest.mark.parametrize(("energy", "level"), [("0x1p9999", 0), ("nan", 0), ("0x1p3", 10**9)])
def test_a_forged_state_is_rejected(energy, level, settings, messages, tmp_path):
    """Its checksum fits: whoever writes one on purpose sees to that."""
    compressor, path = Compressor(settings), tmp_path / "state"
    take(compressor, messages, 37)
    compressor.save(path)
    arrays, metadata = storage.read(path)
    metadata["trees"]["object"]["nodes"][0] |= {"level": level, "energy": energy}
    storage.write(path, arrays, metadata)
    with pytest.raises(ProtocolError, match="use an older copy"):
        Compressor.load(path, settings)


def test_a_tree_is_no_compressor(settings, tmp_path):
    Compressor(settings).trees["object"].save(tmp_path / "tree")
    with pytest.raises(ServiceError, match="is of kind None, this catstream reads 'compressor 3'"):
        Compressor.load(tmp_path / "tree", settings)


def test_a_checkpoint_of_another_version_is_rejected_with_one_line(settings, messages, tmp_path):
    compressor, path = Compressor(settings), tmp_path / "000000000001.safetensors"
    take(compressor, messages, 37)
    arrays, metadata = compressor.state()
    storage.write(path, arrays, metadata | {"kind": "compressor 1"})
    with pytest.raises(ServiceError, match="is of kind 'compressor 1', this catstream reads 'compressor 3'") as error:
        CheckpointStore(tmp_path).load(settings)
    assert "\n" not in str(error.value)


def test_a_state_of_another_coreset_size_is_rejected(settings, messages, tmp_path):
    compressor = Compressor(settings)
    take(compressor, messages, 37)
    compressor.save(tmp_path / "state")
    with pytest.raises(SettingsError, match="same settings"):
        Compressor.load(tmp_path / "state", settings.but({"coreset.size": 16}))


def test_a_state_of_another_reduction_is_rejected(settings, messages, tmp_path):
    compressor = Compressor(settings)
    take(compressor, messages, 37)
    compressor.save(tmp_path / "state")
    (other,) = TREES.keys() - {settings.coreset.reduction}
    with pytest.raises(SettingsError, match=r"holds trees of coreset.reduction=.*same settings"):
        Compressor.load(tmp_path / "state", settings.but({"coreset.reduction": other}))
