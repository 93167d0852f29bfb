"""`catstream watch` and `catstream status` of a running pipeline."""

import dataclasses
import json
import os
import re
import select
import signal

import pytest

from catstream.cli.status import Status
from catstream.features.layout import ROW_LENGTH
from catstream.pipeline import Pipeline
from catstream.processes.start_server import NAMES
from catstream.wire.messages import Health, Track

SECONDS = 500  # timeout on a busy machine
#: A pipeline continues only if its tracks are received.
SETTINGS = {"run.unstored_frames": 1}


@pytest.fixture(scope="module")
def resting(video):
    """A pipeline that has learned its first model, and waits."""
    with Pipeline(*video, SETTINGS) as running:
        for track in running:
            if track.model_version:
                break
        yield running


def test_watch_prints_tracks_and_features_until_the_end(long_video, catstream):
    with Pipeline(*long_video, SETTINGS) as running:
        place = ["--endpoint", running.endpoint]
        features = catstream("watch", "features", "--count", 3, *place)
        tracks = catstream("watch", "tracks", "--json", *place)
        for _ in running:
            for watcher in (features, tracks):
                select.select([watcher.stdout], [], [], 1)  # while it starts, few pass
        shown, _ = features.communicate(timeout=SECONDS)
        output, errors = tracks.communicate(timeout=SECONDS)
    found = [json.loads(line) for line in output.splitlines()]
    assert found[0].keys() == {field.name for field in dataclasses.fields(Track)}
    assert [track["frame"] for track in found] == list(range(60 - len(found), 60))
    assert errors.startswith(f"{len(found)} messages, {60 - len(found)} missed"), "those before it came"
    assert errors.endswith(": the source has ended\n")
    lines = shown.splitlines()
    assert len(lines) == 3
    words = ("frame ", "training (", "appearance (", "labels ")
    assert any(all(word in line for word in words) for line in lines), "not all frames are taught"
    assert (tracks.returncode, features.returncode) == (0, 0)


def test_watch_describes_the_arrays_of_the_last_model(resting, said):
    code, output, errors = said("watch", "models", "--count", 1, "--json", "--endpoint", resting.endpoint)
    model = json.loads(output)
    assert model["version"] >= 1
    assert model["weights"].keys() == {"dtype", "shape", "norm"}
    assert (model["weights"]["dtype"], model["weights"]["shape"]) == ("float32", [ROW_LENGTH])
    assert (code, errors) == (0, "1 message, 0 missed\n")


def test_ctrl_c_ends_watch_without_an_error(resting, catstream):
    process = catstream("watch", "health", "--endpoint", resting.endpoint)
    assert process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=SECONDS)
    assert (process.returncode, "Traceback" in errors) == (0, False)


def test_status_shows_all_processes(resting, said, until):
    command = ["status", "--endpoint", resting.endpoint, "--wait", SECONDS]
    until(lambda: "trees" in said(*command)[1])  # the compressor may have reported before there was a box
    code, output, errors = said(*command)
    assert (code, errors) == (0, "")
    assert [line.split()[0] for line in output.splitlines()] == [
        "pipeline", "state", "frames", "learning", "model", "trees", "rejected", "reports",
    ]  # fmt: skip
    assert all(name in output for name in NAMES)
    found = json.loads(said(*command, "--json")[1])
    assert (found["ok"], found["processes"].keys()) == (True, set(NAMES))


def test_status_fails_and_names_a_silent_process(resting, said):
    os.kill(resting.pids["trainer"], signal.SIGSTOP)
    try:
        code, output, errors = said("status", "--endpoint", resting.endpoint, "--wait", 3)
    finally:
        os.kill(resting.pids["trainer"], signal.SIGCONT)
    assert code == 1
    assert "trainer" not in output
    # On a busy machine, other processes may be late too.
    assert re.fullmatch(r"catstream: no health report at .* within 3 s from: .*trainer(:.*)?\n", errors)


def test_lines_of_status_depend_on_the_reports():
    counters = {"sent": 9.0, "processed": 9.0, "stored": 9.0, "skipped": 2.0, "model_version": 3.0}
    status = Status("run", processes={"detector": Health("detector", 1.0, counters)})
    status.processes["compressor"] = Health("compressor", 1.0, {"frames": 1.0})
    lines = dict(status.lines())
    assert lines["source"] == "2 frames skipped", "a demo never reconnects"
    assert "trees" not in lines, "there are none before the first box"
    counters["reconnects"] = counters["skipped"] = 1.0
    trees = {"leaves": 7.0, "nodes": 5.0, "level": 1.0, "bytes": 4.6e6}
    status.processes["compressor"] = Health("compressor", 1.0, trees)
    lines = dict(status.lines())
    assert lines["source"] == "1 frame skipped, 1 reconnect"
    assert lines["trees"] == "7 leaves, 5 nodes, level 1, 4.6 MB"
