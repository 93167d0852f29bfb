"""The state on disk, and who may have it."""

from __future__ import annotations

import fcntl
import os
import stat
import subprocess
import sys

import numpy as np
import pytest

from catstream import storage
from catstream.errors import ServiceError
from catstream.state import files, locked, restore


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
        "import pathlib, time\nfrom catstream.state import locked\n"
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
