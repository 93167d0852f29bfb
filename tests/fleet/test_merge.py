"""Merging the saved models of streams: each frame counts once, in any order, within the bound of the coreset."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.settings import Settings
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.compression.compressor import Compressor
from catstream.compression.forest import Forest
from catstream.compression.reduce import energy
from catstream.errors import FleetError
from catstream.features.layout import row_length
from catstream.fleet.fleet import merge_streams
from catstream.fleet.store import Store
from catstream.jobs.job import Job
from catstream.jobs.saved_model import SavedModel, disjoint
from catstream.jobs.state import files
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features
from tests.learning import features, rows_of

SETTINGS = Settings(coreset={"size": 4})

PART = st.tuples(st.sets(st.integers(0, 5), min_size=1), st.integers(0, 9))
PARTS = st.dictionaries(st.text("abcdef", min_size=1), PART)


def stream(seed, frames=12):
    """The features of an object in some frames."""
    rng = np.random.default_rng(seed)
    return [features(rng) for _ in range(frames)]


def learned(seed):
    compressor = Compressor(SETTINGS, "anna")
    for frame, each in enumerate(stream(seed)):
        compressor.take(frame, each, compressor.version + 1)
    return SavedModel.of(compressor, SETTINGS)


@given(PARTS, st.randoms())
def test_merged_models_share_no_frames_are_maximal_and_do_not_depend_on_the_order(parts, random):
    chosen = disjoint(parts)
    together = set().union(*(parts[name][0] for name in chosen))
    assert len(together) == sum(len(parts[name][0]) for name in chosen)
    assert all(origins & together for origins, _ in parts.values())
    shuffled = list(parts)
    random.shuffle(shuffled)
    again = disjoint({name: parts[name] for name in shuffled})
    assert [parts[name] for name in again] == [parts[name] for name in chosen]


@pytest.fixture
def store(tmp_path):
    """A store with the states of three streams, which know anna."""
    (tmp_path / "store").mkdir()
    for seed, name in enumerate(["door", "yard", "hall"]):
        put_state(tmp_path, name, seed)
    return (tmp_path / "store").as_uri()


def put_state(tmp_path, name, seed, frames=12):
    """Put the state of a stream into the store after some frames."""
    folder = tmp_path / f"{name}-{frames}"
    (folder / "trees").mkdir(parents=True)
    Job(f"{name}.mp4", settings=SETTINGS).save(folder)
    forest = Forest(SETTINGS)
    for frame, each in enumerate(stream(seed, frames)):
        forest.take(Features(frame, 0.0, {"anna": each}))
    CheckpointStore(folder / "trees").save(forest)
    Store(str(tmp_path / "store")).stream(name).claim("here").write(files(folder), {})


def test_the_newest_states_are_merged_within_the_bound_and_new_models_are_stored(store, tmp_path):
    streams = ["door", "yard", "hall", "gate"]
    merged = merge_streams(store, streams, "anna", named=False)
    assert (set(merged.streams), merged.skipped) == ({"door", "yard", "hall"}, ())
    first = Store(store).model("anna").newest()
    assert first.files["model"] == merged.model
    tree = SavedModel.from_bytes(merged.model, "").trees["object"]
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(row_length(), 3)))[0].astype(np.float32)
    rows = [each.training[APPEARANCE].rows[:4] for seed in range(3) for each in stream(seed)]
    truth, kept = energy(np.vstack(rows) @ basis), energy(rows_of(tree) @ basis)
    assert tree.rows_seen == sum(map(len, rows))
    assert truth - tree.dropped_energy - 1e-5 * truth <= kept <= truth * (1 + 1e-5)
    assert merge_streams(store, streams[::-1], "anna", named=False).model == merged.model
    assert Store(store).model("anna").newest(first.token) is None
    put_state(tmp_path, "yard", 1, 14)
    assert set(merge_streams(store, streams, "anna", named=False).streams) == set(merged.streams)
    assert Store(store).model("anna").newest().token > first.token


def test_of_streams_that_share_frames_the_one_with_the_most_is_merged(store, tmp_path):
    put_state(tmp_path, "porch", 0, 14)  # the frames of the door, and two more
    merged = merge_streams(store, ["door", "porch", "yard"], "anna", named=False)
    assert (set(merged.streams), merged.skipped) == ({"porch", "yard"}, ("door",))
    assert SavedModel.from_bytes(merge_streams(store, ["hall"], "", named=True).model, "").origins == learned(2).origins


def test_a_stream_that_is_named_has_to_know_the_object(store):
    for streams, name, why in [
        (["door"], "ben", "stream door: there is no object 'ben'"),
        (["door", "gate"], "anna", "stream gate: no state in the store yet"),
    ]:
        with pytest.raises(FleetError, match=why):
            merge_streams(store, streams, name, named=True)
    with pytest.raises(FleetError, match="no stream has learned of 'ben' yet"):
        merge_streams(store, ["door", "gate"], "ben", named=False)
    with pytest.raises(FleetError, match="pass --object NAME, or the names of the streams"):
        merge_streams(store, ["door", "yard"], "", named=False)
