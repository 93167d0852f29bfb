"""The state on disk, and who may have it."""

import subprocess
import sys
from pathlib import Path

import pytest

from catstream.errors import ServiceError
from catstream.run.state import files, locked, restore


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
