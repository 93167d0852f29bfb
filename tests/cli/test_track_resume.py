"""`catstream track --state` and `--resume`: what was learned outlives every process, and its results continue."""

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
def wreck(video, program, until, tmp_path_factory):
    """What is left of a run that was killed with all its processes, as by a power cut: its place, and a copy of it."""
    source, box = video
    place = tmp_path_factory.mktemp("killed") / "run"
    # Nobody reads its standard output: the run waits once the pipe is full, half of the frames later.
    results = ["--output", place / "out", "--video", "--state", place / "kept", "--write", "-"]
    command = [*program, "track", source, "--box", box, *map(str, results), *OFTEN]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, pipesize=4096)
    kept, out = place / "kept", place / "out"
    until(lambda: process.poll() is not None or (len(checkpoints(kept)) > 1 and len(frames(out)) >= 6))
    assert process.poll() is None, process.communicate()[1]
    kill_everything(process)
    process.stdout.close()
    process.stderr.close()
    return place, shutil.copytree(place, place.with_name("copy"))


@pytest.fixture
def killed(wreck):
    """The place of a run that was killed, as it was left: its results in `out`, its state in `kept`."""
    place, copy = wreck
    shutil.rmtree(place)
    return shutil.copytree(copy, place)


def test_a_run_whose_processes_were_all_killed_resumes_with_each_frame_once(killed, whole_run, succeed, fail, tmp_path):
    kept, out = killed / "kept", killed / "out"
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


def test_a_state_folder_that_is_in_use_or_has_other_settings_is_rejected(killed, video, fail, tmp_path):
    kept, (source, box) = killed / "kept", video
    refusals = {
        "continue it": ["track", source, "--box", box, "--state", kept, "--output", killed / "out"],  # which exists
        "started with coreset.size=64, not 32": ["track", "--resume", kept, *OFTEN, "--set", "coreset.size=32"],
        "frames 3 to the last": ["track", "--resume", kept, "--start", "3"],
        "contains no run": ["track", "--resume", tmp_path / "none"],
        "--state and --resume are mutually exclusive": ["track", "--resume", kept, "--state", kept],
        "keeps its objects": ["track", "--resume", kept, "--box", "b=1,2,30,40"],
        "missing SOURCE": ["track", "--box", box, "--state", tmp_path / "new"],
        "missing --state DIR": ["track", source, "--continue"],
        "--continue and --overwrite are": ["track", source, "--state", kept, "--continue", "--overwrite"],
        f"{Path(source).name}' is a file": ["save", tmp_path / "one", "--state", source],
    }
    for word, command in refusals.items():
        assert word in fail(*command)
    with Pipeline(resume=kept):
        assert "a running pipeline uses the state" in fail("track", "--resume", kept)


def test_settings_that_are_given_again_change_and_all_others_stay(video, said, succeed, monkeypatch, tmp_path):
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


def test_a_complete_run_gets_no_further_rows_but_the_files_that_it_lacks(video, succeed, tmp_path):
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


def test_a_run_that_was_killed_continues_by_the_line_of_the_service_that_began_it(
    video, whole_run, program, succeed, until, tmp_path
):
    (source, box), kept, out = video, tmp_path / "state", tmp_path / "tracks"
    (line,) = (
        line.removeprefix("ExecStart=") for line in UNIT.read_text().splitlines() if line.startswith("ExecStart=")
    )
    options = shlex.join(["--box", box, "--write", "-", *OFTEN])
    for name, value in {"%t": tmp_path, "%i": "gate", "$OPTIONS": options, "${SOURCE}": source}.items():
        line = line.replace(name, str(value))
    _, *words = shlex.split(line)
    # Nobody reads the standard output, as above.
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "pipesize": 4096}
    with subprocess.Popen([*program, *words], cwd=tmp_path, **pipes) as process:
        until(lambda: process.poll() is not None or (checkpoints(kept) and len(frames(out)) >= 3))
        assert process.poll() is None, process.stderr.read()
        kill_everything(process)
    before = len(frames(out))
    for says in ("present in", "is complete: to track the source again"):
        _, errors = succeed(*words, cwd=tmp_path)
        assert "the resumed run in state keeps its objects" in errors
        assert says in errors
        assert_goes_on(out / "demo.ndjson", before, whole_run / "out" / "demo.ndjson")


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd-analyze: apt-get install systemd")
@pytest.mark.parametrize("name", ["catstream@gate", "catstream-sink@gate", "catstream-fleet"])
def test_systemd_finds_nothing_wrong_in_a_unit(tmp_path, name):
    unit = tmp_path / f"{name}.service"
    text = (UNITS / unit.name.replace("gate", "")).read_text()
    unit.write_text(text.replace("/opt/catstream/bin/catstream", shutil.which("true")))
    checked = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_new_results_of_a_resumed_run_have_all_frames_also_after_its_end(killed, succeed):
    succeed("track", "--resume", killed / "kept")
    succeed("track", "--resume", killed / "kept", "--output", killed / "new")
    assert frames(killed / "new") == [*range(32)]


def test_a_resumed_run_drops_a_video_and_files_if_it_is_told_so(killed, succeed):
    kept, first, second = killed / "kept", killed / "first.csv", killed / "second.csv"
    succeed("track", "--resume", kept, "--write", first)
    assert Job.load(kept).results.write == (first,)
    first.unlink()
    succeed("track", "--resume", kept, "--no-video", "--write", second)
    results = Job.load(kept).results
    assert (results.output, results.video, results.write) == (killed / "out", False, (second,))
    assert (first.exists(), second.exists()) == (False, True)
