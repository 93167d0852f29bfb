"""Laws of the forest: a message counts once, in order; a restart changes nothing; objects do not affect one another."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_equal

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.coreset import compressor
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.coreset.forest import Forest
from catstream.coreset.tree import CoresetTree
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.wire import storage
from catstream.wire.heads import APPEARANCE, EXTENT, TREES
from catstream.wire.messages import DetectorState, Features, Motion, ObjectFeatures, Sample, TrainingRows
from tests.learning import rows_of

WIDTH = 20

#: Labels of size and aspect of the first rows of a frame.
OFFSETS = np.array([[0.5, 0.5], [0.25, 0.5], [0.5, 0.75]], np.float32)


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> Settings:
    monkeypatch.setattr(compressor, "SAMPLE_INTERVAL", 4)
    monkeypatch.setattr(compressor, "MOTION_FRAMES", 10)
    return Settings(coreset={"size": 8})


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
                EXTENT: TrainingRows(rows[:3], labels[:3], weights[:3], OFFSETS),
            }
            yield Features(frame, frame / 25, {"": ObjectFeatures(box, training)})

    return stream()


def changed(message: Features, **changes: object) -> Features:
    """The message with other fields of its only object."""
    return dataclasses.replace(message, objects={"": dataclasses.replace(message.objects[""], **changes)})


def merged(seq: int, **parts: Features) -> Features:
    """One message of several objects, by name."""
    objects = {name: message.objects[""] for name, message in parts.items()}
    return Features(seq - 1, (seq - 1) / 25, objects)


def take(forest: Forest, messages: Iterator[Features], count: int) -> list[Sample]:
    return [sample for _ in range(count) for sample in forest.take(next(messages))]


def assert_same(sample: Sample, other: Sample) -> None:
    assert_equal(dataclasses.asdict(sample), dataclasses.asdict(other))


def test_each_row_is_inserted_into_the_tree_of_its_label(settings, messages):
    forest = Forest(settings)
    sample = take(forest, messages, 60)[-1]
    frames = sample.frame + 1
    rows = {(APPEARANCE, 1.0): 2, (APPEARANCE, 0.0): 3, (APPEARANCE, None): 6, (EXTENT, None): 3}
    counts = {name: frames * rows[tree.group, tree.label] for name, tree in TREES.items()}
    assert {name: tree.count for name, tree in sample.trees.items()} == counts


def assert_gives_the_loss(tree: CoresetTree, model: np.ndarray, parts: list[TrainingRows], labels: np.ndarray) -> None:
    """||A [w; b; -1]||^2 is the weighted squared error, and C keeps it within the energy dropped."""
    rows, weights = np.vstack([part.rows for part in parts]), np.concatenate([part.weights for part in parts])
    loss = float(weights @ (rows @ model[:WIDTH] + model[WIDTH] - labels) ** 2)
    kept = rows_of(tree).astype(np.float64)
    approximate = float(np.sum((kept @ model) ** 2))
    assert loss * (1 - 1e-5) - tree.dropped_energy * (model @ model) <= approximate <= loss * (1 + 1e-5)


@pytest.mark.parametrize("count", [1, 60], ids=["exact", "reduced"])
def test_tree_of_labelled_rows_gives_the_loss_of_any_model(settings, messages, rng, count):
    forest, seen = Forest(settings), [next(messages) for _ in range(count)]
    for message in seen:
        forest.take(message)
    trees = forest.compressors[""].trees
    parts = [message.objects[""].training[APPEARANCE] for message in seen]
    for _ in range(10):
        model = np.append(rng.normal(size=WIDTH + 1), -1)
        assert_gives_the_loss(trees["loss"], model, parts, np.concatenate([part.labels for part in parts]))
    parts = [message.objects[""].training[EXTENT] for message in seen]
    labels = np.vstack([np.column_stack([part.labels, part.offsets]) for part in parts])
    for column in range(3):
        model = np.zeros(WIDTH + 4)
        model[: WIDTH + 1], model[WIDTH + 1 + column] = rng.normal(size=WIDTH + 1), -1
        assert_gives_the_loss(trees[EXTENT], model, parts, labels[:, column])


def test_object_that_begins_again_has_new_trees(settings, messages):
    forest = Forest(settings)
    take(forest, messages, 20)
    before = forest.version
    assert before
    forest.take(changed(next(messages), begins=True))
    assert forest.counters()["rows"] == 2 + 3 + 6 + 3, "those of one frame"
    assert all(sample.version > before for sample in take(forest, messages, 40)), "no version is used twice"


def test_missing_message_is_an_error_and_a_repeat_is_ignored(settings, messages):
    forest, (first, second) = Forest(settings), (next(messages), next(messages))
    with pytest.raises(ProtocolError, match="features 2 follow 0, 1 are missing"):
        forest.take(second)
    forest.take(first)
    forest.take(second)
    before = forest.counters()
    assert forest.take(second) == forest.take(first) == []
    assert (forest.seq, forest.counters()) == (2, before)


def test_versions_count_up_and_samples_keep_their_distance(settings, messages):
    samples = take(Forest(settings), messages, 400)
    assert [sample.version for sample in samples] == list(range(1, len(samples) + 1))
    apart = np.diff([sample.frame for sample in samples])
    assert apart[0] < compressor.SAMPLE_INTERVAL, "sooner while the trees are small"
    assert (apart[len(apart) // 2 :] >= compressor.SAMPLE_INTERVAL).all()


def test_sample_is_sent_only_after_a_new_leaf(settings, messages):
    forest, idle = Forest(settings), 0
    take(forest, messages, 40)
    for _ in range(40):
        idle += len(forest.take(changed(next(messages), training={})))
    assert idle <= 1


def test_centres_are_sent_in_blocks_with_nan_for_absence(settings, messages):
    samples = take(Forest(settings), messages, 60)
    for sample in samples:
        blocks = (sample.frame + 1) // compressor.MOTION_FRAMES
        assert sample.centres.shape == ((compressor.MOTION_FRAMES if blocks else 0), 2)
        for offset, centre in enumerate(sample.centres):
            frame = (blocks - 1) * compressor.MOTION_FRAMES + offset
            assert_allclose(centre, (frame + 10, 25) if frame % 5 else (np.nan, np.nan))


@pytest.mark.parametrize("names", [[""], ["anna", "ben"]], ids=["one", "two"])
@pytest.mark.parametrize("count", [0, 1, 37])
def test_saved_forest_continues_bit_for_bit(settings, messages, names, count, rng, tmp_path):
    motion, centre = Motion(rng.normal(size=(4, 4)), rng.normal(size=(2, 2))), rng.normal(size=(5, 4))
    windows = [Window(*rng.random(4)) for _ in range(3)]
    detector = DetectorState(7, "lost", *windows, False, 2, motion=motion, centre=centre)
    messages = (changed(message, detector=detector) for message in messages)
    stream = (merged(seq, **{name: next(messages) for name in names}) for seq in itertools.count(1))
    forest = Forest(settings)
    take(forest, stream, count)
    forest.save(tmp_path / "state")
    loaded = Forest.load(tmp_path / "state", settings)
    assert list(loaded.compressors) == (names if count else [])
    assert loaded.counters() == forest.counters()
    assert loaded.versions == forest.versions
    for name, state in loaded.states_at(count).items():
        assert_equal(dataclasses.asdict(state), dataclasses.asdict(detector))
        assert_equal(dataclasses.asdict(loaded.compressors[name].detector), dataclasses.asdict(detector))
    for message in itertools.islice(stream, 40):
        for sample, again in zip(forest.take(message), loaded.take(message), strict=True):
            assert_same(sample, again)


def test_checkpoint_has_the_last_sample_though_trees_have_grown(settings, messages, tmp_path):
    forest, samples = Forest(settings), []
    assert forest.last_samples == []
    while len(samples) < 3:
        samples += take(forest, messages, 1)
    assert not take(forest, messages, 2)
    forest.save(tmp_path / "state")
    assert_same(Forest.load(tmp_path / "state", settings).last_samples[0], samples[-1])


def test_checkpoint_has_detector_states_of_the_last_256_messages(settings, tmp_path):
    states = {seq: DetectorState(seq, "lost", *[Window(1.0, 2.0, 3.0, 4.0)] * 3) for seq in range(1, 301)}
    forest = Forest(settings)
    assert forest.states_at(5) == {}
    for seq, state in states.items():
        forest.take(Features(seq - 1, 0.0, {"anna": ObjectFeatures(None, detector=state)}))
    forest.save(tmp_path / "state")
    for each in (forest, Forest.load(tmp_path / "state", settings)):
        known = [each.states_at(seq)["anna"].first_frame for seq in (1, 45, 46, 300, 1 << 62)]
        assert known == [45, 45, 46, 300, 300], "or the nearest one"


@pytest.mark.parametrize("kind", [None, "compressor 1"])
def test_file_of_another_kind_or_version_is_an_error(settings, kind, tmp_path):
    storage.write(tmp_path / "000000000001.safetensors", {}, {"kind": kind} if kind else {})
    with pytest.raises(ServiceError, match=rf"is of kind {kind!r}, this catstream reads 'forest 4'"):
        CheckpointStore(tmp_path).load(settings)


def test_checkpoint_of_another_size_is_an_error_but_no_damage(settings, messages, tmp_path):
    store, forest = CheckpointStore(tmp_path), Forest(settings)
    take(forest, messages, 37)
    store.save(forest)
    with pytest.raises(SettingsError, match="same settings"):
        store.load(settings.replace({"coreset.size": 16}))
    assert not store.trouble


def test_object_among_several_is_learned_as_alone(settings, messages):
    """Only the numbers of its samples and its name differ: all objects share one count."""
    several, alone, versions = Forest(settings), {"anna": Forest(settings), "ben": Forest(settings)}, []
    for seq in range(1, 80):
        parts = {name: dataclasses.replace(next(messages), frame=seq - 1) for name in alone}
        others = {name: sample for name, part in parts.items() for sample in alone[name].take(part)}
        for sample in several.take(merged(seq, **parts)):
            other = others.pop(sample.object)
            assert_same(dataclasses.replace(sample, version=other.version, object=""), other)
            versions.append(sample.version)
        assert not others, "each object has a sample when it has one alone"
    assert versions == list(range(1, len(versions) + 1))
    assert versions[-1] == several.version == several.counters()["version"]


def test_object_without_a_part_in_a_message_is_dropped(settings, messages):
    forest = Forest(settings)
    forest.take(merged(1, anna=next(messages), ben=next(messages)))
    kept = forest.compressors["ben"]
    forest.take(merged(2, ben=next(messages)))
    assert forest.compressors == {"ben": kept}
    assert forest.object_counters().keys() == {"ben"}
    forest.take(merged(3, ben=next(messages), anna=next(messages)))
    assert forest.object_counters()["anna"]["rows"] == 2 + 3 + 6 + 3, "those of one frame"


def test_take_calls_back_after_each_object(settings, messages):
    """The process counts an iteration for the watchdog: all objects together may take long."""
    calls = []
    Forest(settings).take(merged(1, anna=next(messages), ben=next(messages)), after_object=lambda: calls.append(1))
    assert len(calls) == 2


def test_features_of_another_length_are_rejected(settings, messages):
    forest = Forest(settings)
    forest.take(next(messages))
    message = next(messages)
    forest.check_features(message)
    rows = TrainingRows.labelled(np.ones((3, WIDTH - 1)), 1)
    with pytest.raises(ProtocolError, match="same settings"):
        forest.check_features(changed(message, training={EXTENT: rows}))
