"""Checkpoints on disk: the last two, each complete; damage is detected and reported."""

import errno
import os

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.coreset.forest import Forest
from catstream.wire.heads import GROUPS
from catstream.wire.messages import Features, ObjectFeatures, TrainingRows

SETTINGS = Settings(coreset={"size": 8})


@pytest.fixture
def grow(rng):
    """Inserts a number of messages into a forest, and returns it."""

    def take(forest, count=1):
        for seq in range(forest.seq + 1, forest.seq + count + 1):
            rows, labels = rng.normal(size=(4, 9)).astype(np.float32), np.float32([1, 0, 0, 0.5])
            training = {group: TrainingRows.labelled(rows, labels) for group in GROUPS}
            forest.take(Features(seq - 1, 0.0, {"": ObjectFeatures(None, training)}))
        return forest

    return take


@pytest.fixture
def checkpoints(grow, tmp_path):
    """A folder of three checkpoints, after 40, 50 and 60 messages; the store has removed the first."""
    forest, store = grow(Forest(SETTINGS), 30), CheckpointStore(tmp_path)
    for _ in range(3):
        assert store.save(grow(forest, 10))
    return tmp_path


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def newest(folder):
    return max(folder.glob("*.safetensors"))


def test_two_newest_checkpoints_remain_and_the_newest_is_loaded(checkpoints):
    assert files(checkpoints) == ["000000000002.safetensors", "000000000003.safetensors"]
    assert CheckpointStore(checkpoints).load(SETTINGS).seq == CheckpointStore(checkpoints).position()[0] == 60


def test_empty_folder_begins_a_new_forest(tmp_path):
    assert CheckpointStore(tmp_path).load(SETTINGS).seq == 0
    assert CheckpointStore(tmp_path).position() == (0, 0.0)


@pytest.mark.parametrize(
    "damaged",
    [
        pytest.param(lambda whole: whole[:0], id="empty"),
        pytest.param(lambda whole: whole[:-10], id="incomplete"),
        pytest.param(lambda whole: whole[:-1] + bytes([whole[-1] ^ 1]), id="a bit of an array"),
    ],
)
def test_damaged_checkpoint_is_detected_and_the_one_before_used(checkpoints, damaged, caplog):
    newest(checkpoints).write_bytes(damaged(newest(checkpoints).read_bytes()))
    store = CheckpointStore(checkpoints)
    assert CheckpointStore(checkpoints).position()[0] == store.load(SETTINGS).seq == 50
    assert "damaged checkpoints: 1; the checkpoint of frame 49 was used" in store.trouble
    assert "cannot be used" in caplog.text


def test_checkpoint_after_a_damaged_one_keeps_the_valid_one(checkpoints, grow):
    newest(checkpoints).write_bytes(b"torn")
    store = CheckpointStore(checkpoints)
    assert store.save(grow(store.load(SETTINGS), 5))
    assert files(checkpoints) == ["000000000002.safetensors", "000000000004.safetensors", "damaged"]
    newest(checkpoints).write_bytes(b"torn")
    assert CheckpointStore(checkpoints).load(SETTINGS).seq == 50


def test_folder_without_a_valid_checkpoint_starts_again(checkpoints):
    for path in checkpoints.iterdir():
        path.write_bytes(b"")
    store = CheckpointStore(checkpoints)
    assert store.load(SETTINGS).seq == 0
    assert "damaged checkpoints: 2; training starts again" in store.trouble


def test_full_disk_is_reported_and_keeps_the_checkpoints(checkpoints, grow, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before, store = files(checkpoints), CheckpointStore(checkpoints)
    forest = grow(store.load(SETTINGS), 5)
    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        assert not store.save(forest)
    assert "No space left on device" in store.trouble
    assert files(checkpoints) == before
    assert CheckpointStore(checkpoints).load(SETTINGS).seq == 60
    assert store.save(forest)
    assert not store.trouble
    assert CheckpointStore(checkpoints).load(SETTINGS).seq == 65


@pytest.mark.parametrize("disk", [1 << 20], indirect=True)
def test_full_disk_removes_older_checkpoints_for_the_next_one(disk, fill, grow, caplog):
    forest, store = grow(Forest(SETTINGS), 30), CheckpointStore(disk)
    for durable in (True, False, False):
        assert store.save(grow(forest, 10), durable=durable)
    fill()
    stored = [forest.seq]
    while store.save(grow(forest, 5), durable=False):
        stored.append(forest.seq)
        fill()
    assert len(stored) > 1, "the older ones made room"
    assert len(files(disk)) == 2, "the newest one, and the ballast"
    assert CheckpointStore(disk).position()[0] == stored[-1]
    assert "(No space left on device): free space on the disk" in store.trouble
    assert len(caplog.messages) == 1


def test_newest_durable_checkpoint_survives_a_power_cut(grow, tmp_path):
    forest, store = Forest(SETTINGS), CheckpointStore(tmp_path)
    for durable in (True, False, True, False, False, False):
        assert store.save(grow(forest, 10), durable=durable)
    assert files(tmp_path) == [f"{number:012d}.safetensors" for number in (3, 5, 6)]
    for path in sorted(tmp_path.iterdir())[1:]:
        path.write_bytes(bytes(path.stat().st_size))  # as after a power cut: the name is on disk, the content is not
    assert CheckpointStore(tmp_path).load(SETTINGS).seq == 30
