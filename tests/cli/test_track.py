"""`catstream track` of videos: its results, and its errors."""

import csv
import errno
import json
import os
import signal
import socket
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from catstream.base.box import Box
from catstream.cli import progress as progress_module
from catstream.cli.progress import RunProgress
from catstream.cli.track import Outcome
from catstream.client.saved_model import SavedModel
from catstream.output.track_log import Log
from catstream.pipeline import Pipeline
from catstream.processes.job import JOB, Results
from catstream.video.source import open_source

FILES = ["demo.csv", "demo.mp4", "demo.ndjson"]


def table(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def frames_of(folder, name="demo"):
    """The frames whose tracks are in the log."""
    return [frame.number for frame in Log(folder / f"{name}.ndjson")]


def test_track_writes_a_log_in_two_forms_and_a_video(whole_run):
    out = whole_run / "out"
    assert "32 messages sent, 32 stored" in (whole_run / "stderr").read_text()
    assert sorted(file.name for file in out.iterdir()) == FILES
    rows = table(out / "demo.csv")
    assert all(float(row["processing"]) >= 0 for row in rows)
    assert [int(row["frame"]) for row in rows] == list(range(32))
    assert {row["state"] for row in rows} <= {"bootstrapping", "present", "absent"}
    header, *tracks = (out / "demo.ndjson").read_text().splitlines()
    assert tracks == (whole_run / "stdout").read_text().splitlines()
    assert header == Log(out / "demo.ndjson").header().to_json()
    assert frames_of(out) == list(range(32))
    with open_source(out / "demo.mp4") as film:
        assert sum(1 for _ in film) == 32


def test_part_has_a_row_for_each_tracked_frame(video, succeed, tmp_path):
    source, box = video
    part, out = ["--start", "4", "--end", "32", "--stride", "4"], tmp_path / "[red]a[b]"
    _, errors = succeed("track", source, "--box", box, *part, "--output", out)
    assert str(out.name) in errors, "brackets in a path are printed as they are"
    assert [int(row["source_frame"]) for row in table(out / "demo.csv")] == list(range(4, 32, 4))
    header = Log(out / "demo.ndjson").header()
    stated = (header.source, header.size, header.rate, header.frames, header.start, header.stride)
    assert stated == (source, (320, 240), 30, 7, 4, 4)
    assert header.boxes == {"": Box.parse(box)}


def test_object_of_a_saved_model_is_found(whole_run, video, succeed, tmp_path):
    succeed("track", video[0], "--model", whole_run / "model", "--output", tmp_path)
    rows = table(tmp_path / "demo.csv")
    assert [row["state"] for row in rows[3:]] == ["present"] * 29  # each frame is searched for one of three sizes
    assert int(rows[0]["model_version"]) >= 1


def test_two_lockstep_runs_write_the_same_bytes(video, whole_run, succeed, tmp_path):
    source, box = video
    results = ["--output", tmp_path / "out", "--write", "-", "--save-model", tmp_path / "model"]
    output, _ = succeed("track", source, "--box", box, *results, "--lockstep")
    assert output == (whole_run / "stdout").read_text()
    assert [json.loads(line)["frame"] for line in output.splitlines()] == list(range(32))
    for file in ("model", "out/demo.ndjson"):
        assert (tmp_path / file).read_bytes() == (whole_run / file).read_bytes()
    newest = int(table(tmp_path / "out" / "demo.csv")[-1]["model_version"])
    assert SavedModel.load(tmp_path / "model").model.version >= newest > 2


def test_closed_pipe_ends_the_run_silently(video, catstream):
    source, box = video
    process = catstream("track", source, "--box", box, "--write", "-")
    assert json.loads(process.stdout.readline())["frame"] == 0
    process.stdout.close()
    assert process.stderr.read().strip() == ""
    process.stdout = None
    assert process.wait(500) == 1


def test_terminated_run_keeps_its_results(long_video, said, until, tmp_path):
    source, box = long_video  # it is not over before the signal comes
    more = ["--video", "--save-model", tmp_path / "model", "--set", "run.unstored_frames=1", "--lockstep"]

    def stop():
        until(lambda: len(frames_of(tmp_path)) > 8)
        found = running()
        os.kill(os.getpid(), signal.SIGTERM)
        return found

    with ExitStack() as stack:  # in which SIGTERM is not ignored
        stack.callback(signal.signal, signal.SIGTERM, signal.signal(signal.SIGTERM, lambda *_: None))
        children = stack.enter_context(ThreadPoolExecutor(1)).submit(stop)
        code, _, errors = said("track", source, "--box", box, "--output", tmp_path, *more)
    assert code == 128 + signal.SIGTERM
    assert "the results so far are kept" in errors
    rows = frames_of(tmp_path)
    assert rows == list(range(len(rows)))
    assert len(table(tmp_path / "demo.csv")) == len(rows)
    with open_source(tmp_path / "demo.mp4") as film:  # it may be short of the frame at which the signal came
        assert len(rows) - sum(1 for _ in film) in (0, 1)
    assert SavedModel.load(tmp_path / "model").model.version >= 1
    assert (len(children.result()), running()) == (3, [])


def running():
    """The processes of pipelines of this process."""
    found = []
    for each in (each for server in psutil.Process().children() for each in server.children()):
        with suppress(psutil.NoSuchProcess):  # it ends meanwhile
            found += [each] * (each.status() != psutil.STATUS_ZOMBIE)
    return found


REJECTED = {
    "a file that is not there": (["none.mp4"], "no video or folder"),
    "a box outside": (["--box", "anna=400,10,20,20"], "anna: the box 400,10,20,20"),
    "two objects with one name": (["--box", "anna=1,2,30,40", "--box", "anna=5,6,30,40"], "its own name"),
    "two objects without a name": (["--box", "1,2,30,40", "--box", "5,6,30,40"], "NAME=5,6,30,40"),
    "a box and a model of one object": (["--box", "anna=1,2,30,40", "--model", "anna=notes.txt"], "mutually exclusive"),
    "a model of several objects": (["--box", "a=1,2,30,40", "--box", "b=1,2,30,40", "--save-model", "m"], "NAME=FILE"),
    "a preset that does not exist": (["--preset", "cat11"], "cat11"),
    "a settings file that is not there": (["--settings", "none.toml"], "cannot read none.toml"),
    "a broker": (["--write", "mqtt://me:s3cret@10.0.0.7/yard"], "catstream sink mqtt://10.0.0.7/yard"),
    "a folder of events": (["--write", "events/"], "catstream sink events/"),
}


@pytest.mark.parametrize(("arguments", "word"), REJECTED.values(), ids=REJECTED)
def test_invalid_input_is_an_error_and_nothing_is_written(video, fail, tmp_path, arguments, word):
    source, box = video
    (tmp_path / "notes.txt").write_text("not a video\n")
    given = arguments if not arguments[0].startswith("--") else [source, *arguments]
    given = given if "--box" in given else [*given, "--box", box]
    error = fail("track", *given, "--output", "out", cwd=tmp_path)
    assert word in error
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_used_port_of_the_page_is_an_error_before_the_run(video, fail, tmp_path):
    source, box = video
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        line = fail("track", source, "--box", box, "--state", tmp_path / "state", "--view", port)
    assert f"cannot listen on 127.0.0.1:{port} (Address already in use)" in line
    assert not (tmp_path / "state").exists()


def test_path_without_permission_is_an_error(said, monkeypatch, tmp_path):
    def denied(*_):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path))

    monkeypatch.setattr(Path, "is_dir", denied)
    code, _, errors = said("evaluate", tmp_path)
    expected = f"cannot use {str(tmp_path)!r} (Permission denied): change its permissions, or use another path"
    assert (code, errors) == (1, f"catstream: {expected}\n")


def test_interrupted_run_reports_models_that_were_not_saved(video, said, monkeypatch, tmp_path):
    monkeypatch.setattr(Pipeline, "by_frame", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    source, _ = video  # without a box: nothing is learned, however late the interrupt arrives
    code, _, errors = said("track", source, "--save-model", tmp_path / "model", "--write", tmp_path / "tracks.csv")
    assert (code, list(tmp_path.iterdir())) == (130, [])
    assert "saved model:" not in errors
    assert "nothing was learned" in errors
    assert errors.endswith(f"no frame was tracked\nstopped: not saved: {tmp_path / 'model'}\n")


def test_interrupted_run_states_what_is_left_and_how_to_continue(tmp_path):
    outcome = Outcome(tmp_path, False, 5, missing=["a.csv"], models=["m"], interrupted=True)
    assert "a.csv" in next(outcome.lines())
    removed = f"the state in {tmp_path} was removed, so the run cannot be resumed"
    assert outcome.interruption() == f"some results are missing; not saved: m; {removed}"
    (tmp_path / JOB).touch()
    kept = replace(outcome, missing=[], models=[]).interruption()
    assert kept == f"the results so far are kept; to continue: catstream track --resume {tmp_path}"


def test_doubtful_options_are_reported_before_the_run(video, said, succeed, tmp_path):
    source, box = video
    words = ["--box", f"a={box}", "--box", f"b={box}", "--save-model", f"a={tmp_path / 'a'}"]
    _, errors = succeed("track", source, *words, "--end", 24)
    assert "a and b have the same box: each costs time" in errors
    assert f"saved model: {tmp_path / 'a'}" in errors.replace("\n", "")
    code, _, errors = said("track", source, "--box", f"a={box}", "--save-model", f"c={tmp_path / 'c'}", "--end", 12)
    first, last = errors.splitlines()[0], errors.splitlines()[-1]
    assert code == 1
    assert first == "there is no object c yet: its model is saved if one begins under this name"
    assert "c" in last
    _, errors = succeed("track", source, "--box", f"a={box}", "--save-model", tmp_path / "only", "--end", 12)
    assert "there is no object" not in errors, "without a name, the only one is meant"


def test_waiting_time_does_not_count_for_the_rate(monkeypatch):
    seconds = [100.0]
    monkeypatch.setattr(progress_module.time, "perf_counter", lambda: seconds[0])
    pipeline = SimpleNamespace(holding="", live=False, frames=9, health={}, totals={}, restarts=0, results=Results())
    progress = RunProgress(pipeline)
    track = SimpleNamespace(box=None, model_version=1, state="lost", score=0.0)
    for passed, holding in [(0.5, ""), (190.0, "waiting"), (0.5, ""), (2.0, None), (60.0, "paused"), (2.0, None)]:
        seconds[0] += passed
        pipeline.holding = holding or ""
        progress.idle() if holding is not None else progress.count({"": track})
    assert "2 frames, present in 0, 0 frames/s, first track after 3.00 s" in progress.summary()
    assert progress._seconds() == pytest.approx(2.0)


def test_paused_run_does_not_replace_results_of_another(video, catstream, succeed, tmp_path):
    source, box = video
    place = str(tmp_path / "my run")
    run = catstream("track", source, "--box", box, "--output", tmp_path, "--paused", "--set", f"run.endpoint={place}")
    assert f"paused: to continue, catstream resume --endpoint '{place}'" in run.stderr.readline()
    log = tmp_path / "demo.ndjson"
    log.write_text("of another run")
    succeed("resume", "--endpoint", place)
    assert f"{log} exists already: replace it with --overwrite" in run.communicate(timeout=500)[1]
    assert (run.returncode, log.read_text()) == (1, "of another run")
