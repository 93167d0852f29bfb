"""The state on disk, and who may have it."""

from __future__ import annotations

import fcntl
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from catstream.errors import ServiceError
from catstream.messages import storage
from catstream.run.state import files, locked, restore


@pytest.fixture
def umask():
    """Sets the umask for one test."""
    before = os.umask(0)
    yield os.umask
    os.umask(before)


def test_a_file_without_a_secret_has_the_permissions_of_the_umask(tmp_path, umask):
    umask(0o027)
    storage.write(tmp_path / "tree", {}, {})
    assert stat.S_IMODE((tmp_path / "tree").stat().st_mode) == 0o640


def test_arrays_of_each_type_are_read_as_they_were_written(tmp_path, rng):
    numbers = rng.uniform(0, 200, size=(3, 5))
    arrays = {name: numbers.astype(name) for name in ("uint8", "float32", "bool", "int64", "float64", "int32")}
    arrays |= {"empty": np.empty((0, 4), np.float32), "columns": np.asfortranarray(numbers), "größe": numbers[0]}
    storage.write(tmp_path / "tree", arrays, {"size": 3})
    read, metadata = storage.read(tmp_path / "tree")
    assert {name: (array.dtype, array.tolist()) for name, array in read.items()} == {
        name: (array.dtype, array.tolist()) for name, array in arrays.items()
    }
    assert metadata == {"size": 3}


def test_a_folder_is_locked_by_one_process_and_free_once_that_is_killed(tmp_path):
    script = (
        "import pathlib, time\nfrom catstream.run.state import locked\n"
        f"with locked(pathlib.Path({str(tmp_path)!r})):\n    print(flush=True)\n    time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as owner:
        owner.stdout.readline()
        with pytest.raises(ServiceError, match="stop it, or give another folder"), locked(tmp_path):
            pass
        owner.kill()
    with locked(tmp_path):
        pass


def test_two_processes_that_ask_whether_a_file_is_locked_do_not_see_each_other(tmp_path):
    path = tmp_path / "note"
    path.touch()
    with path.open() as one, path.open() as other, path.open() as owner:
        assert not storage.is_locked(one.fileno())
        assert not storage.is_locked(other.fileno()), "the first one still holds its shared lock"
        for asking in (one, other):
            fcntl.flock(asking, fcntl.LOCK_UN)
        assert storage.lock(owner.fileno())
        assert storage.is_locked(one.fileno())


def test_two_writers_of_one_file_do_not_disturb_each_other(tmp_path):
    """Each reader sees what one of them wrote, whole."""
    contents = [bytes([value]) * 200_000 for value in (1, 2)]
    storage.write_atomically(tmp_path / "file", contents[0])

    def write(content):
        for _ in range(60):
            storage.write_atomically(tmp_path / "file", content)

    with ThreadPoolExecutor(2) as pool:
        writers = [pool.submit(write, content) for content in contents]
        while not all(writer.done() for writer in writers):
            assert (tmp_path / "file").read_bytes() in contents
    assert [writer.result() for writer in writers] == [None, None]
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_saved_model_that_is_stored_while_a_state_is_read_is_in_it_if_it_is_named(tmp_path, monkeypatch):
    for name in ("trees/000001.safetensors", "desired_state.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    read_bytes = Path.read_bytes

    def read(path):
        if path.suffix == ".json":  # the detector stores a saved model, and then the state that names it
            (tmp_path / "searched_models").mkdir(exist_ok=True)
            (tmp_path / "searched_models" / "0a.safetensors").write_text("model")
            path.write_text('{"model": "0a"}')
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", read)
    content = files(tmp_path)
    assert b"0a" in content["desired_state.json"]
    assert "searched_models/0a.safetensors" in content


def test_the_files_of_a_state_are_restored_with_the_models_that_are_searched_for_and_the_newest_checkpoint(tmp_path):
    names = ["desired_state.json", "job.safetensors", "searched_models/0af3.safetensors", "trees/000002.safetensors"]
    for name in [*names, "trees/000001.safetensors", "log", "searched_models/.part"]:
        (tmp_path / "old" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "old" / name).write_text(name)
    content = files(tmp_path / "old")
    assert sorted(content) == names
    restore(tmp_path / "new", content)
    assert all((tmp_path / "new" / name).read_text() == name for name in names)
    with pytest.raises(ServiceError, match="is not a file of the state"):
        restore(tmp_path / "new", {"searched_models/../x.safetensors": b""})
