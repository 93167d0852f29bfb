"""A saved model: the file, the trees that continue from it, and merging."""

import dataclasses
import warnings
from contextlib import nullcontext

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.client.saved_model import SavedModel, check_sizes, merge
from catstream.coreset.compressor import Compressor
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.features.layout import ROW_LENGTH
from catstream.wire import storage
from catstream.wire.heads import TREES
from tests.learning import BOX, features

SIZE, WIDTH, FRAMES = 8, ROW_LENGTH, 60
SETTINGS = Settings(coreset={"size": SIZE})


def stream(seed, frames=FRAMES, appearance=1.0):
    rng = np.random.default_rng(seed)
    return [features(rng, appearance) for _ in range(frames)]


def compressed(messages, compressor=None, settings=SETTINGS, name=""):
    """A compressor after these features."""
    compressor = compressor or Compressor(settings, name)
    for message in messages:
        compressor.take(compressor.frame + 1, message, compressor.version + 1)
    return compressor


def learn(messages, settings=SETTINGS, name=""):
    return SavedModel.of(compressed(messages, None, settings, name), settings)


@pytest.fixture(scope="module")
def messages():
    return stream(1)


@pytest.fixture(scope="module")
def learned(messages):
    return learn(messages)


def bits(trees):
    return {(name, key): array.tobytes() for name, tree in trees.items() for key, array in tree.state()[0].items()}


def test_saved_model_is_loaded_bit_for_bit(learned, tmp_path):
    learned.save(tmp_path / "one")
    assert SavedModel.load(tmp_path / "one").to_bytes() == learned.to_bytes()


@pytest.mark.parametrize("half", [7, 30, 53])
def test_continued_stream_gives_the_trees_of_one_stream(messages, half, tmp_path):
    learn(messages[:half]).save(tmp_path / "one")
    continued = compressed(messages[half:], SavedModel.load(tmp_path / "one").compressor(SETTINGS))
    assert bits(continued.trees) == bits(compressed(messages).trees)


def test_samples_continue_after_the_version_of_the_saved_model(learned, messages):
    compressor, version, before = learned.compressor(SETTINGS), learned.model.version, bits(learned.trees)
    assert compressor.version == compressor.last_sample.version == version
    samples = [compressor.take(frame, message, compressor.version + 1) for frame, message in enumerate(messages)]
    versions = [sample.version for sample in samples if sample]
    assert versions == list(range(version + 1, version + 1 + len(versions)))
    assert versions
    assert bits(learned.trees) == before, "the run has trees of its own"


def test_run_without_a_sample_or_detection_cannot_be_saved(learned):
    with pytest.raises(ServiceError, match="nothing was learned"):
        learn(stream(1, 1))
    (message,) = stream(2, 1)
    searched = dataclasses.replace(message, box=None, detector=dataclasses.replace(message.detector, first_window=None))
    compressor = compressed([searched], learned.compressor(SETTINGS))
    with pytest.raises(ServiceError, match="the object of the saved model was not found yet"):
        SavedModel.of(compressor, SETTINGS)


def test_model_of_other_features_is_an_error(learned, tmp_path, monkeypatch):
    learned.save(tmp_path / "one")
    monkeypatch.setattr("catstream.client.saved_model.ROW_LENGTH", WIDTH + 1)
    with pytest.raises(ProtocolError, match=f"{WIDTH} features of a window, this catstream has {WIDTH + 1}"):
        SavedModel.load(tmp_path / "one")


@pytest.mark.parametrize("tree", TREES)
def test_file_without_one_of_the_trees_is_an_error(learned, tree):
    arrays, metadata = storage.decode(learned.to_bytes(), "one")
    trees = {name: each for name, each in metadata["trees"].items() if name != tree}
    with pytest.raises(ProtocolError, match=f"it has no tree '{tree}': track the object again"):
        SavedModel.from_bytes(storage.encode(arrays, {**metadata, "trees": trees}), "one")


def test_merged_model_has_all_rows_in_any_order(learned):
    large = dataclasses.replace(learn(stream(2), name="anna"), box=BOX.scaled(4, 2))
    larger = dataclasses.replace(learn(stream(3, 35)), box=BOX.scaled(16, 4))
    for parts in ([learned, large, larger], [larger, learned, large]):
        merged = merge(parts)
        assert merged.object == "anna"
        assert (merged.box.w, merged.box.h) == pytest.approx((4 * BOX.w, 2 * BOX.h))
        for name, tree in merged.trees.items():
            assert tree.rows_seen == sum(part.trees[name].rows_seen for part in parts)
            np.testing.assert_allclose(tree.sum, sum(part.trees[name].sum for part in parts), rtol=1e-9, atol=1e-6)


def test_models_that_do_not_fit_are_not_merged(learned, messages):
    longer = SavedModel.of(compressed(stream(2), learned.compressor(SETTINGS)), SETTINGS)
    anna, other = learn(stream(1), name="anna"), Settings(coreset={"size": 16})
    for models, error in (
        ([learned], "two or more"),
        ([learned, "a.safetensors"], r"got 'a.safetensors': read a file with catstream.SavedModel.load"),
        ([learned, learned], "the same frames"),
        ([longer, learned], "the same frames"),
        ([learned, learn(messages[:30])], "the same frames"),
        ([anna, learn(stream(2), other)], "coreset.size=8, another coreset.size=16"),
        ([anna, learn(stream(2), name="ben")], r"different objects \('anna', 'ben'\)"),
    ):
        with pytest.raises(SettingsError, match=error):
            merge(models)


def turned(*parts):
    """A model of an object whose features differ from the background's in some of four parts of the row."""
    return learn(stream(sum(parts), appearance=np.where(np.isin(np.arange(WIDTH) * 4 // WIDTH, parts), 1, -1)))


def test_models_in_doubt_are_merged_with_a_warning():
    with pytest.warns(UserWarning, match=r"models 1 and 2 look like different objects \(similarity 0\.[34]"):
        merge([turned(0, 1, 2), turned(1, 2, 3)])


def test_views_of_an_object_have_to_resemble_one_other_view():
    front, between, back = turned(0, 1), turned(0, 1, 2, 3), turned(2, 3)
    for parts in ([front, back, between], [between, front, back], [front, between, back]):
        with warnings.catch_warnings(action="ignore"):
            merge(parts)
    with pytest.raises(SettingsError, match=r"models [12] and 3 look like"):
        merge([front, turned(0, 1, 1), back])  # the second one is of other frames of the front


def test_file_without_any_of_its_parts_is_an_error(learned):
    arrays, metadata = storage.decode(learned.to_bytes(), "whole")
    wrong = [(arrays, {**metadata, name: None}) for name in metadata]
    optional = ("model.motion.", "model.heads.")  # a model may be without them
    for name in (name for name in arrays if not name.startswith(optional)):
        rest = {other: array for other, array in arrays.items() if other != name}
        wrong += [(rest | other, metadata) for other in ({}, {name: np.float32([[np.nan]])}, {name: np.float32(1)})]
    for parts in wrong:
        with pytest.raises(ProtocolError, match="not a saved model"):
            SavedModel.from_bytes(storage.encode(*parts), "one")


@pytest.mark.parametrize(
    ("mebibytes", "message"),
    [
        ({"anna": 63, "ben": 63, "": 63}, None),
        ({"anna": 64}, r"the saved model of anna is too large \(64 MiB, limit 63\): .*coreset.size"),
        ({"a": 60, "b": 60, "c": 60, "d": 30}, r"a, b, c, d are too large .*\(210 MiB together, limit 200\)"),
    ],
)
def test_saved_models_are_limited_by_their_size_in_a_message(mebibytes, message):
    sizes = {name: size << 20 for name, size in mebibytes.items()}
    with nullcontext() if message is None else pytest.raises(SettingsError, match=message):
        check_sizes(sizes)
