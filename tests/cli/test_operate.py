"""`catstream set-box`, `search`, `forget`, `pause`, `resume`, `save` and `stop`, as a person uses them."""

import csv
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest

from catstream.base.box import Box
from catstream.client.saved_model import SavedModel
from catstream.pipeline import Pipeline
from catstream.wire.discovery import private_folder, reserve_endpoint
from tests.learning import learned_from

NEED_A_PIPELINE = [["set-box", "1,2,3,4"], ["search", "one"], ["save", "one"], ["watch", "tracks"]]
NEED_A_PIPELINE += [[name] for name in ("forget", "pause", "resume", "stop", "status")]
PATIENT = ("--timeout", 500)


@pytest.fixture
def steer(said, tmp_path):
    """Gives a command to the pipeline of this test: exit code, what it said."""

    def give(*words):
        code, output, errors = said(*words, "--endpoint", tmp_path / "run", *PATIENT)
        assert "Traceback" not in errors
        return code, (output or errors).strip()

    return give


@pytest.fixture
def status(succeed, tmp_path):
    """The figures of `catstream status` about the pipeline of this test."""

    def ask():
        output, _ = succeed("status", "--json", "--endpoint", tmp_path / "run", "--wait", 500)
        return json.loads(output)

    return ask


@pytest.fixture
def follow(tmp_path):
    """Follows a source in the pipeline of this test, in a thread: its tracks follow."""
    over = Event()

    def tracks(source, box=None):
        found = []
        with Pipeline(source, box, {"run.endpoint": str(tmp_path / "run")}) as pipeline:
            for each in pipeline.by_frame(0.1):
                found += each.values()
                if over.is_set():
                    break
        return found

    with ThreadPoolExecutor(1) as pool:
        yield lambda *given: pool.submit(tracks, *given)
        over.set()


def rows(folder):
    return list(csv.DictReader((folder / "demo.csv").read_text().splitlines()))


def test_run_without_a_box_waits_for_set_box_and_resume(video, catstream, steer, status, until, tmp_path):
    source, box = video
    run = catstream("track", source, "--output", tmp_path / "out", "--set", f"run.endpoint={tmp_path / 'run'}")
    assert steer("pause") == (0, "paused before the first frame")
    assert status()["state"] == "waiting"
    code, answer = steer("set-box", box)
    assert (code, answer) == (0, f"the object begins at {box} in frame 0")
    assert status()["state"] == "paused"
    until(lambda: steer("save", tmp_path / "one")[0] == 0)  # once there is a model of the frame of the box
    assert SavedModel.load(tmp_path / "one").model.frame == 0
    assert steer("set-box", box, "--keep") == (0, f"the same object continues at {box} in frame 1")
    assert steer("resume") == (0, "resumed after frame 1")
    errors = run.communicate(timeout=500)[1]
    assert run.returncode == 0, errors
    (hint,) = (line for line in errors.splitlines() if line.startswith("waiting for a box: "))
    assert f"catstream view --endpoint {tmp_path / 'run'}" in hint
    assert f"catstream set-box [NAME=]X,Y,W,H --endpoint {tmp_path / 'run'}" in hint
    assert "32 messages sent, 32 stored" in errors
    assert len(rows(tmp_path / "out")) == 32


def test_objects_begin_and_are_forgotten_by_name_in_a_paused_run(video, follow, said, steer, status, until, tmp_path):
    source, box = video
    run = follow(source)  # it waits for a box
    assert steer("pause")[0] == 0
    assert steer("set-box", f"anna={box}")[0] == 0
    code, answer = steer("set-box", "ben=20,150,70,60")
    assert (code, answer.startswith("the object ben begins at 20,150,70,60 in frame")) == (0, True)
    until(lambda: status()["processes"]["detector"]["objects"].keys() == {"anna", "ben"})
    table = said("status", "--endpoint", tmp_path / "run", "--wait", 500)[1].splitlines()
    assert table[-3].split() == ["object", "state", "score", "model", "leaves"]
    assert {line.split()[0] for line in table[-2:]} == {"anna", "ben"}
    code, answer = steer("forget")
    assert (code, answer.endswith("ambiguous object: this run tracks anna, ben; pass a name")) == (1, True)
    assert "dora, emil begin in frame" in steer("set-box", "dora=20,150,70,60", "emil=20,20,60,60")[1]
    assert [steer("forget", name)[0] for name in ("dora", "emil")] == [0, 0]
    learned_from(source, Box.parse(box), slice(12)).save(tmp_path / "one")
    assert steer("search", f"fay={tmp_path / 'one'}")[1].startswith("fay is searched for from frame")
    assert steer("forget", "fay")[0] == 0
    assert steer("forget", "anna")[1].startswith("anna is no longer tracked after frame")
    assert steer("forget")[1].endswith("no object is left, so the run waits for a box")
    assert status()["state"] == "waiting"
    assert steer("stop")[0] == 0
    assert {track.object for track in run.result(500)} == {"anna", "ben", "dora", "emil"}


@pytest.mark.parametrize("words", NEED_A_PIPELINE, ids=" ".join)
def test_if_no_pipeline_runs_that_is_reported_in_one_line(fail, tmp_path, words):
    nowhere = {"TMPDIR": str(tmp_path), "XDG_RUNTIME_DIR": ""}
    assert fail(*words, env=nowhere).startswith("catstream: no pipeline of yours is running: start one")


def test_command_names_the_only_pipeline_that_it_selects(said, fail, commanded):
    with (
        private_folder() as own,
        reserve_endpoint("", own, source="/films/walk.mp4") as place,
        commanded(place) as heard,
    ):
        answer = said("stop")
    assert answer == (0, "stop was done\n", f"pipeline: /films/walk.mp4 at {place}\n")
    assert heard == ["stop"]
    assert "is empty" in fail("stop", "--endpoint", "")


def test_at_an_endpoint_that_a_pipeline_has_left_no_command_is_answered(fail, tmp_path):
    error = fail("stop", "--endpoint", tmp_path, "--timeout", 1)
    assert error.startswith(f"catstream: no answer to stop from {tmp_path} within 1 s: is a pipeline running there?")


def test_password_is_removed_from_the_command_line_that_others_can_read(catstream, tmp_path, until):
    sink = catstream("sink", "mqtt://me:s3cret@127.0.0.1:9/yard", "--endpoint", tmp_path)
    line = Path(f"/proc/{sink.pid}/cmdline")
    until(lambda: b"mqtt://127.0.0.1:9/yard" in line.read_bytes())
    assert b"s3cret" not in line.read_bytes()
