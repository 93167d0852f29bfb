"""The job of a run as a file, and the lock of its state folder."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.errors import ProtocolError, ServiceError
from catstream.processes.job import Job, Results
from catstream.processes.state import files, locked, locked_for_run
from catstream.wire import storage

JOB = Job("rtsp://me:secret@10.0.0.7/one", {"anna": Box(1, 2, 30, 40)}, part=slice(0, None, 1), size=(320, 240))
FULL = Job(
    "größe.mp4",
    {"anna": Box(1, 2, 30, 40)},
    models={"ben": Path("ben.safetensors")},
    part=slice(np.int64(1), 9, 2),
    settings=Settings(run={"lag_frames": 3}),
    size=(320, 240),
    results=Results(Path("größe"), True, (Path("a.csv"),), {"carl": Path("carl")}, rotate="1d", keep=3),
    state=Path("state"),
    since=1.5,
    resume=True,
)


@pytest.mark.parametrize("job", [JOB, FULL], ids=["some fields", "all fields"])
def test_job_is_read_as_it_was_written(tmp_path, job):
    assert Job.load(job.save(tmp_path)) == Job.load(tmp_path) == job


def test_file_of_a_job_is_private_from_its_first_byte(tmp_path, monkeypatch):
    before = os.umask(0)
    try:
        left = tmp_path / f".job.safetensors.{0:016x}.part"
        left.write_text("what a power cut left of an older catstream")
        os.utime(left, (0, 0))
        modes, fsync = [], os.fsync
        monkeypatch.setattr(os, "fsync", lambda handle: (modes.append(os.fstat(handle).st_mode), fsync(handle)))
        file = JOB.save(tmp_path)
    finally:
        os.umask(before)
    assert list(tmp_path.iterdir()) == [file]
    assert {stat.S_IMODE(mode) for mode in (modes[0], file.stat().st_mode)} == {0o600}


def test_repr_of_a_job_hides_its_password():
    assert "secret" not in repr(JOB)


def test_missing_or_damaged_job_is_an_error(tmp_path):
    with pytest.raises(ServiceError, match="'my runs' contains no run: start one with --state 'my runs'"):
        Job.load(Path("my runs"))
    file = JOB.save(tmp_path)
    file.write_bytes(file.read_bytes().replace(b"320", b"321"))
    with pytest.raises(ProtocolError, match="checksum"):
        Job.load(tmp_path)


@pytest.mark.parametrize(
    ("field", "value"), [("size", [320]), ("resume", "yes"), ("models", ["ben"]), ("boxes", {"": [1, 2]}), ("part", 3)]
)
def test_field_of_another_type_is_an_error(tmp_path, field, value):
    file = JOB.save(tmp_path)
    storage.write(file, {}, storage.read_metadata(file) | {field: value})
    with pytest.raises(ProtocolError, match="is not a valid job of a pipeline"):
        Job.load(file)


def test_forked_copy_of_a_process_does_not_keep_its_lock(tmp_path):
    lives, ends = os.pipe()
    with locked(tmp_path / "state"):
        if not os.fork():
            os.close(ends)
            os.read(lives, 1)
            os._exit(0)
    with locked(tmp_path / "state"):
        os.close(ends)
    os.wait()
    os.close(lives)


def test_folder_is_locked_until_its_process_ends(tmp_path):
    script = (
        "import pathlib, time\nfrom catstream.processes.state import locked\n"
        f"with locked(pathlib.Path({str(tmp_path)!r})):\n    print(flush=True)\n    time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as owner:
        owner.stdout.readline()
        with pytest.raises(ServiceError, match="stop it, or use another folder"), locked(tmp_path):
            pass
        owner.kill()
    with locked(tmp_path):
        pass


def test_model_stored_while_a_state_is_read_is_in_it(tmp_path, monkeypatch):
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


def test_resumed_run_writes_its_own_or_the_earlier_files():
    earlier = Results(Path("out"), video=True, write=(Path("a.csv"), Path("b.sqlite")))
    assert Results().after(earlier) == earlier
    assert Results(write=(Path("c.csv"),)).after(earlier).write == (Path("c.csv"),)
    assert Results(video=False, write=()).after(earlier) == Results(Path("out"), video=False, write=())
    assert Results(keep=7).after(Results(rotate="1d", keep=30)) == Results(rotate="1d", keep=7)


def test_state_folder_without_its_job_cannot_be_resumed(tmp_path):
    (tmp_path / "trees").mkdir()
    with (
        pytest.raises(ServiceError, match=r"without its job\.safetensors, which cannot be continued: use another"),
        locked_for_run(tmp_path, None, JOB),
    ):
        pass
