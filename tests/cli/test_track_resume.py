"""`catstream track --state` and `--resume`: a run continues after all its processes were killed."""

import csv
import json
import os
import shlex
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.client.saved_model import SavedModel
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.pipeline import Pipeline
from catstream.processes.job import Job
from catstream.processes.state import CHECKPOINTS
from catstream.video.source import open_source

UNITS = Path(__file__).parents[2] / "services"
UNIT = UNITS / "catstream@.service"
OFTEN = ["--set", "run.checkpoint_seconds=0.05", "--lockstep"]


def frames(folder):
    path = folder / "demo.csv"
    return [int(row["frame"]) for row in csv.DictReader(path.read_text().splitlines())] if path.exists() else []


def assert_goes_on(log, before, whole):
    """What was logged stays, and the rest follows: each frame once, with the object.

    Frames that were learned from but not logged are tracked with the newer model: their boxes may differ a little.
    """
    tracks = [json.loads(line) for line in log.read_text().splitlines()[1:]]
    expected = [json.loads(line) for line in whole.read_text().splitlines()[1:]]
    assert tracks[:before] == expected[:before]
    assert [track["frame"] for track in tracks] == list(range(32))
    assert all(
        Box(*track["box"]).overlap(Box(*other["box"])) > 0.8 for track, other in zip(tracks, expected, strict=True)
    )


def checkpoints(folder):
    return list((folder / CHECKPOINTS).glob("*.safetensors"))


def kill_everything(process):
    """The command and all its children, which die with it."""
    family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    for one in family:
        with suppress(psutil.NoSuchProcess):  # it died with the command
            one.kill()
    process.wait()
    psutil.wait_procs(family, 30)


@pytest.fixture(scope="module")
def line(video, tmp_path_factory):
    """The words of the command that the systemd unit runs, for the stream `gate` and in its folder."""
    (start,) = (line for line in UNIT.read_text().splitlines() if line.startswith("ExecStart="))
    source, box = video
    options = shlex.join(["--box", box, "--video", "--write", "-", *OFTEN])
    for name, value in {
        "%t": tmp_path_factory.mktemp("runtime"),
        "%i": "gate",
        "$OPTIONS": options,
        "${SOURCE}": source,
    }.items():
        start = start.replace(name, str(value))
    return shlex.split(start)[1:]


@pytest.fixture(scope="module")
def wreck(line, program, until, tmp_path_factory):
    """What is left of a run that was killed with all its processes, as by a power cut: its place, and a copy of it."""
    place = tmp_path_factory.mktemp("killed") / "run"
    place.mkdir()
    # Nobody reads its standard output: the run waits once the pipe is full, half of the frames later.
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "pipesize": 4096}
    with subprocess.Popen([*program, *line], cwd=place, **pipes) as process:
        kept, out = place / "state", place / "tracks"
        until(lambda: process.poll() is not None or (len(checkpoints(kept)) > 1 and len(frames(out)) >= 6))
        assert process.poll() is None, process.communicate()[1]
        kill_everything(process)
    return place, shutil.copytree(place, place.with_name("copy"))


@pytest.fixture
def killed(wreck):
    """The place of a run that was killed, as it was left: its results in `tracks`, its state in `state`."""
    place, copy = wreck
    shutil.rmtree(place)
    return shutil.copytree(copy, place)


def test_killed_run_resumes_with_each_frame_once(killed, whole_run, succeed, fail, tmp_path):
    kept, out = killed / "state", killed / "tracks"
    before = len(frames(out))
    assert before < 32
    _, errors = succeed("track", "--resume", kept)
    assert_goes_on(out / "demo.ndjson", before, whole_run / "out" / "demo.ndjson")
    assert frames(out) == list(range(32))
    assert "32 messages sent, 32 stored" in errors
    assert CheckpointStore(kept / CHECKPOINTS).load(Settings()).seq == 32
    output, _ = succeed("save", tmp_path / "one", "--state", kept)
    saved = SavedModel.load(tmp_path / "one")
    assert output == f"model {saved.model.version} is in {tmp_path / 'one'}\n"
    assert saved.model.version == CheckpointStore(kept / CHECKPOINTS).load(Settings()).version
    assert "one exists already: replace it with --overwrite" in fail("save", tmp_path / "one", "--state", kept)
    succeed("save", tmp_path / "one", "--state", kept, "--overwrite")


def test_invalid_state_folder_is_an_error(killed, video, fail, tmp_path):
    kept, (source, box) = killed / "state", video
    refusals = {
        "continue it": ["track", source, "--box", box, "--state", kept, "--output", killed / "tracks"],  # which exists
        "started with coreset.size=64, not 32": ["track", "--resume", kept, *OFTEN, "--set", "coreset.size=32"],
        "frames 3 to the last": ["track", "--resume", kept, "--start", "3"],
        "contains no run": ["track", "--resume", tmp_path / "none"],
        "state and resume are mutually exclusive": ["track", "--resume", kept, "--state", kept],
        "keeps its objects": ["track", "--resume", kept, "--box", "b=1,2,30,40"],
        "missing SOURCE": ["track", "--box", box, "--state", tmp_path / "new"],
        "missing --state DIR": ["track", source, "--continue"],
        "--resume and --continue continue": ["track", source, "--state", kept, "--continue", "--overwrite"],
        f"{Path(source).name}' is a file": ["save", tmp_path / "one", "--state", source],
    }
    for word, command in refusals.items():
        assert word in fail(*command)
    with Pipeline(resume=kept):
        elsewhere = ["--set", f"run.endpoint={tmp_path / 'run'}"]
        assert "a running pipeline uses the state" in fail("track", "--resume", kept, *elsewhere)


def test_resumed_run_changes_only_the_settings_passed(video, said, succeed, monkeypatch, tmp_path):
    monkeypatch.setattr(Pipeline, "by_frame", lambda *_: iter(()))  # kept when it starts: no frame has to be followed
    (source, box), kept = video, tmp_path / "kept"
    assert said("track", source, "--box", box, "--state", kept, *OFTEN)[0] == 0
    (tmp_path / "mine.toml").write_text("[run]\nunstored_frames = 99\nlag_frames = 7\n")
    lag, mine = "run.lag_frames=3", "run.unstored_frames=99"
    for options, changed in {
        ("--set", "run.unstored_frames=512"): ["run.lockstep=true", "run.unstored_frames=512"],
        ("--set", "run.unstored_frames=256", "--set", "run.lockstep=false"): [],
        ("--settings", tmp_path / "mine.toml"): [lag, mine],
        ("--lockstep",): ["run.lockstep=true", lag, mine],
    }.items():
        variables = {"CATSTREAM_RUN_LAG_FRAMES": "3"} if "--settings" in options else {}
        succeed("track", "--resume", kept, *options, env=variables)
        assert Job.load(kept).settings.changed() == [*changed, "run.checkpoint_seconds=0.05"]


def test_resumed_complete_run_writes_only_missing_files(video, succeed, tmp_path):
    (source, box), kept, out = video, tmp_path / "kept", tmp_path / "out"
    succeed("track", source, "--box", box, "--end", 6, "--output", out, "--video", "--state", kept)
    before, written = (out / "demo.ndjson").read_bytes(), [file.stat().st_mtime_ns for file in out.iterdir()]
    output, errors = succeed("track", "--resume", kept)
    assert not output
    assert [file.stat().st_mtime_ns for file in out.iterdir()] == written
    assert f"no frames remained to track, the run in {kept} is complete: to track the source again" in errors
    (out / "demo.csv").unlink()
    os.truncate(out / "demo.mp4", 9999)
    succeed("track", "--resume", kept, "--start", 0, "--end", 6)  # the same frames
    assert frames(out) == list(range(6))
    assert (out / "demo.ndjson").read_bytes() == before
    with open_source(out / "demo.mp4") as annotated:
        assert annotated.frames == 6


def test_killed_service_continues_by_its_own_command(killed, line, whole_run, succeed):
    log = killed / "tracks" / "demo.ndjson"
    before = len(frames(log.parent))
    for says in ("present in", "is complete: to track the source again"):
        _, errors = succeed(*line, cwd=killed)
        assert "the resumed run in state keeps its objects" in errors
        assert says in errors
        assert_goes_on(log, before, whole_run / "out" / "demo.ndjson")


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd-analyze: apt-get install systemd")
@pytest.mark.parametrize("name", ["catstream@gate", "catstream-sink@gate", "catstream-fleet"])
def test_systemd_unit_is_valid(tmp_path, name):
    unit = tmp_path / f"{name}.service"
    text = (UNITS / unit.name.replace("gate", "")).read_text()
    unit.write_text(text.replace("/opt/catstream/bin/catstream", shutil.which("true")))
    checked = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_resumed_run_writes_the_destinations_passed(killed, succeed):
    kept, (csv, other), new = killed / "state", (killed / name for name in ("a.csv", "b.csv")), killed / "new"
    succeed("track", "--resume", kept, "--write", csv, "--write", other)
    before = other.read_bytes()
    succeed("track", "--resume", kept, "--no-video", "--write", csv, "--output", new)
    results = Job.load(kept).results
    assert (results.output, results.video, results.write) == (new, False, (csv,))
    assert (other.read_bytes(), sorted(file.name for file in new.iterdir())) == (before, ["demo.csv", "demo.ndjson"])
    assert frames(new) == [*range(32)]
