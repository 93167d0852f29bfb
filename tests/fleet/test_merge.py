"""Merging the saved models of streams: each frame counts once, in any order, within the bound of the coreset."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catstream.box import Box, Window
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.compression.compressor import Compressor
from catstream.compression.forest import Forest
from catstream.compression.reduce import energy
from catstream.errors import FleetError
from catstream.features.layout import row_length
from catstream.fleet.merge import Part, disjoint, joined, merge_in_pairs, merge_streams, saved_part
from catstream.fleet.store import Store
from catstream.messages.heads import APPEARANCE, EXTENT
from catstream.messages.kinds import DetectorState, Features, ObjectFeatures, TrainingRows
from catstream.run.job import Job
from catstream.run.learned import Learned, merge
from catstream.run.state import files
from catstream.settings import Settings

SETTINGS = Settings(coreset={"size": 4})
BOX = Box(1.0, 2.0, 30.0, 40.0)
WINDOW = Window(0.0, 0.0, 40.0, 50.0)

parts = st.dictionaries(
    st.text("abcdef", min_size=1), st.builds(Part, st.frozensets(st.integers(0, 5), min_size=1), st.integers(0, 9))
)


def stream(seed, frames=12):
    """The features of an object in some frames: rows of the object around 1, and of a background around -1."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.float32([1, 0]), 4)
    for _ in range(frames):
        rows = rng.normal(scale=0.2, size=(8, row_length())).astype(np.float32) + np.where(labels[:, None], 1, -1)
        training = {APPEARANCE: TrainingRows.labelled(rows, labels), EXTENT: TrainingRows.labelled(rows[:4], 1)}
        yield ObjectFeatures(BOX, training, DetectorState(0, "confident", WINDOW, WINDOW, WINDOW))


def learned(seed, frames=12, before=None):
    compressor = Compressor(SETTINGS, "anna") if before is None else before.compressor(SETTINGS, "anna")
    for frame, features in enumerate(stream(seed, frames)):
        compressor.take(frame, features, compressor.version + 1)
    return Learned.of(compressor, SETTINGS)


@pytest.fixture(scope="module")
def models():
    """What five streams have learned."""
    return [learned(seed, frames=8 + seed) for seed in range(5)]


def merge_models(models):
    """Saved models that are merged in this process as the nodes of a cluster merge them."""
    read = {str(number): model for number, model in enumerate(models)}
    kept = disjoint({name: Part.of(Learned.from_bytes(model, "")) for name, model in read.items()})
    return merge_in_pairs([read[name] for name in kept], joined)


@given(parts)
def test_the_parts_that_are_merged_share_no_frames_and_no_other_one_could_be_added(given_parts):
    chosen = disjoint(given_parts)
    origins = [given_parts[name].origins for name in chosen]
    together = frozenset().union(*origins)
    assert len(together) == sum(map(len, origins))
    assert all(each.origins & together for each in given_parts.values())


@given(parts, st.randoms())
def test_the_choice_does_not_depend_on_the_order_and_repeats_itself(given_parts, random):
    shuffled = list(given_parts)
    random.shuffle(shuffled)
    chosen = disjoint(given_parts)
    assert [given_parts[name] for name in disjoint({name: given_parts[name] for name in shuffled})] == [
        given_parts[name] for name in chosen
    ]
    origins = frozenset().union(*(given_parts[name].origins for name in chosen))
    merged = Part(origins, sum(given_parts[name].rows for name in chosen))
    with_merged = given_parts | {"merged": merged}
    again = [with_merged[name] for name in disjoint(with_merged)]
    assert sum(len(each.origins) for each in again) == len(merged.origins)
    assert sum(each.rows for each in again) == merged.rows


@given(st.integers(1, 300))
def test_pairs_are_merged_in_as_few_rounds_as_possible_each_model_once(count):
    depth, numbers = merge_in_pairs(
        [(0, [number]) for number in range(count)], lambda one, other: (max(one[0], other[0]) + 1, one[1] + other[1])
    )
    assert numbers == list(range(count))
    assert depth == (count - 1).bit_length()


def coreset(tree):
    return np.vstack([*(node.rows for node in tree.nodes), tree.pending])


@settings(max_examples=10)
@given(seeds=st.lists(st.integers(0, 4), min_size=2, max_size=5, unique=True), seed=st.integers(0, 99))
def test_merged_in_pairs_the_trees_keep_the_frames_of_all_within_the_bound_as_merged_at_once(models, seeds, seed):
    chosen = [models[number] for number in seeds]
    pairs = Learned.from_bytes(merge_models([model.to_bytes() for model in chosen]), "merged")
    once = merge(chosen)
    assert set(pairs.origins) == set(once.origins)
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(row_length(), 3)))[0].astype(np.float32)
    rows = [each.training[APPEARANCE].rows[:4] for s in seeds for each in stream(s, 8 + s)]
    truth = energy(np.vstack(rows) @ basis)
    for tree in (pairs.trees["object"], once.trees["object"]):
        assert tree.rows_seen == sum(map(len, rows))
        kept, slack = energy(coreset(tree) @ basis), 1e-5 * truth
        assert truth - tree.dropped_energy - slack <= kept <= truth + slack


def test_merging_again_or_with_what_was_merged_before_changes_nothing(models):
    data = [model.to_bytes() for model in models[:3]]
    whole = merge_models(data)
    assert merge_models([*data, whole]) == merge_models([whole]) == merge_models([whole, whole]) == whole
    assert merge_models([*data, data[1]]) == merge_models(data[::-1]) == whole


def test_of_two_states_of_one_stream_the_later_one_counts_and_so_does_one_that_continued():
    early, late, other = learned(7, 6), learned(7, 12), learned(8)
    assert Learned.from_bytes(merge_models([early.to_bytes(), late.to_bytes()]), "").origins == late.origins
    both = learned(9, before=early)
    found = Learned.from_bytes(merge_models([late.to_bytes(), both.to_bytes(), other.to_bytes()]), "")
    assert set(found.origins) == {*both.origins, *other.origins}


def test_newer_states_of_the_streams_take_the_place_of_what_was_merged_before():
    before = merge_models([learned(seed, 6).to_bytes() for seed in (1, 2)])
    newer = [learned(seed, 12) for seed in (1, 2)]
    again = Learned.from_bytes(merge_models([before, *(each.to_bytes() for each in newer)]), "")
    assert Part.of(again) == Part.of(merge(newer))


@pytest.fixture
def store(tmp_path):
    """A store with the states of three streams, which know anna."""
    (tmp_path / "store").mkdir()
    for seed, name in enumerate(["door", "yard", "hall"]):
        put_state(tmp_path, name, seed)
    return store_of(tmp_path)


def store_of(folder):
    return (folder / "store").as_uri()


def put_state(tmp_path, name, seed, frames=12):
    """Put the state of a stream into the store after some frames."""
    folder = tmp_path / f"{name}-{frames}"
    (folder / "trees").mkdir(parents=True)
    Job(f"{name}.mp4", settings=SETTINGS).save(folder)
    forest = Forest(SETTINGS)
    for frame, features in enumerate(stream(seed, frames)):
        forest.take(Features(frame + 1, frame, 0.0, {"anna": features}))
    CheckpointStore(folder / "trees").save(forest)
    Store(store_of(tmp_path)).stream(name).claim("here").write(files(folder), {})


def test_the_part_of_a_stream_is_what_its_newest_state_has_learned(store):
    part, data = saved_part(store, "hall", "anna", named=True)
    assert Learned.from_bytes(data, "").origins == learned(2).origins
    assert part == Part.of(learned(2))
    for stream_name, name, why in [
        ("door", "ben", "stream door: there is no object 'ben'"),
        ("gate", "anna", "stream gate: there is no state of it in the store yet"),
    ]:
        assert saved_part(store, stream_name, name, named=False) == (None, None)
        with pytest.raises(FleetError, match=why):
            saved_part(store, stream_name, name, named=True)


def test_objects_without_a_name_are_merged_only_of_streams_that_are_named():
    with pytest.raises(FleetError, match=r"name the object \(--object NAME\), or the streams that show it"):
        merge_streams("", ["door", "yard"], "", named=False)


@pytest.mark.system
def test_the_nodes_merge_the_states_in_the_store_and_only_a_new_model_is_stored(store, tmp_path, site):
    site[0].status()  # this process is connected to the nodes
    streams = ["door", "yard", "hall", "gate"]
    merged = merge_streams(store, streams, "anna", named=False)
    assert set(merged.streams) == {"door", "yard", "hall"}
    assert merged.model == merge_models([learned(seed).to_bytes() for seed in range(3)])
    first = Store(store).model("anna").newest()
    assert first.files["model"] == merged.model
    again = merge_streams(store, streams, "anna", named=False)
    assert again.model == merged.model
    assert set(again.skipped) == {"door", "yard", "hall"}
    assert Store(store).model("anna").newest(first.token) is None
    for seed, name in enumerate(merged.streams):
        put_state(tmp_path, name, streams.index(name), 14 + seed)
    assert set(merge_streams(store, streams, "anna", named=False).streams) == set(merged.streams)
    assert Store(store).model("anna").newest().token > first.token
    with pytest.raises(FleetError, match="stream gate: there is no state of it in the store yet"):
        merge_streams(store, ["door", "gate"], "anna", named=True)
    with pytest.raises(FleetError, match="no stream has learned of 'ben' yet"):
        merge_streams(store, streams, "ben", named=False)
