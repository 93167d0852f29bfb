"""The commands that control a running pipeline, and their errors without one."""

import csv
import json
from pathlib import Path

import pytest

from catstream.client.saved_model import SavedModel
from catstream.wire.discovery import private_folder, reserve_endpoint

NEED_A_PIPELINE = [["set-box", "1,2,3,4"], ["search", "one"], ["save", "one"], ["watch", "tracks"]]
NEED_A_PIPELINE += [[name] for name in ("forget", "pause", "resume", "stop", "status")]


def test_run_is_controlled_while_it_is_paused(video, catstream, said, until, tmp_path):
    def control(*words):
        code, output, errors = said(*words, "--endpoint", tmp_path / "run", "--timeout", 500)
        assert "Traceback" not in errors
        return code, (output or errors).strip()

    def status():
        return json.loads(said("status", "--json", "--endpoint", tmp_path / "run", "--wait", 500)[1])

    source, box = video
    run = catstream("track", source, "--output", tmp_path / "out", "--set", f"run.endpoint={tmp_path / 'run'}")
    assert control("pause") == (0, "paused before the first frame")
    assert status()["state"] == "waiting"
    assert control("set-box", f"anna={box}") == (0, f"the object anna begins at {box} in frame 0")
    assert status()["state"] == "paused"
    until(lambda: control("save", tmp_path / "one")[0] == 0)  # once there is a model of the frame of the box
    assert SavedModel.load(tmp_path / "one").model.frame == 0
    assert control("set-box", f"anna={box}", "--keep") == (0, f"the same object anna continues at {box} in frame 1")

    assert control("set-box", "ben=20,150,70,60", "carl=20,20,60,60")[1].startswith("ben, carl begin in frame")
    until(lambda: status()["processes"]["detector"]["objects"].keys() == {"anna", "ben", "carl"})
    table = said("status", "--endpoint", tmp_path / "run", "--wait", 500)[1].splitlines()
    assert table[-4].split() == ["object", "state", "score", "model", "leaves"]
    assert {line.split()[0] for line in table[-3:]} == {"anna", "ben", "carl"}
    code, answer = control("forget")
    assert (code, answer.endswith("ambiguous object: this run tracks anna, ben, carl; pass a name")) == (1, True)
    assert control("search", f"dora={tmp_path / 'one'}")[1].startswith("dora is searched for from frame")
    assert [control("forget", name)[0] for name in ("ben", "carl", "dora")] == [0, 0, 0]
    assert control("forget")[1].endswith("no object is left, so the run waits for a box")
    assert status()["state"] == "waiting"

    assert control("set-box", f"emil={box}")[0] == 0
    assert control("resume")[1].startswith("resumed after frame")
    errors = run.communicate(timeout=500)[1]
    assert run.returncode == 0, errors
    (hint,) = (line for line in errors.splitlines() if line.startswith("waiting for a box: "))
    assert f"catstream set-box [NAME=]X,Y,W,H --endpoint {tmp_path / 'run'}" in hint
    assert "32 messages sent, 32 stored" in errors
    rows = list(csv.DictReader((tmp_path / "out" / "demo.csv").read_text().splitlines()))
    assert {row["object"] for row in rows} == {"anna", "ben", "carl", "emil"}
    assert {int(row["frame"]) for row in rows} == {*range(32)}


@pytest.mark.parametrize("words", NEED_A_PIPELINE, ids=" ".join)
def test_command_without_a_pipeline_is_an_error(fail, tmp_path, words):
    nowhere = {"TMPDIR": str(tmp_path), "XDG_RUNTIME_DIR": ""}
    assert fail(*words, env=nowhere).startswith("catstream: no pipeline of yours is running: start one")


def test_command_names_the_only_pipeline_that_it_selects(said, fail, commanded):
    with (
        private_folder() as own,
        reserve_endpoint("", own, source="/films/walk.mp4") as place,
        commanded(place) as commands,
    ):
        answer = said("stop")
    assert answer == (0, "stop was done\n", f"pipeline: /films/walk.mp4 at {place}\n")
    assert commands == ["stop"]
    assert "is empty" in fail("stop", "--endpoint", "")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["stop", "--timeout", "1"], "no answer to stop from {} within 1 s"),
        (["watch", "tracks", "--wait", "0.2"], "no health arrived from {} within 0.2 s"),
        (["sink", "tracks.csv", "--wait", "1"], "no health arrived from {} within 1 s"),
    ],
)
def test_endpoint_without_a_pipeline_is_an_error(fail, tmp_path, words, error):
    line = fail(*words, "--endpoint", tmp_path, cwd=tmp_path)
    assert line.startswith(f"catstream: {error.format(tmp_path)}: is a pipeline running there?")
    assert "The folder has no sockets; if it runs, they were removed: restart it." in line
    assert not list(tmp_path.iterdir())


def test_password_is_removed_from_the_command_line(catstream, tmp_path, until):
    sink = catstream("sink", "mqtt://me:s3cret@127.0.0.1:9/yard", "--endpoint", tmp_path)
    line = Path(f"/proc/{sink.pid}/cmdline")
    until(lambda: b"mqtt://127.0.0.1:9/yard" in line.read_bytes())
    assert b"s3cret" not in line.read_bytes()
