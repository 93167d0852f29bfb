"""The page of `catstream annotate` in a real browser: a video is annotated by mouse and keys."""

import csv
import json
import os
import subprocess

import pytest

FRAMES, SIZE = 24, (320, 240)

pytestmark = pytest.mark.system


def run_script(words):
    """Run a script with a browser, and return the lines that it prints."""
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout.splitlines()


def test_video_is_annotated_by_mouse_and_keys(script_of_browser, catstream, demo_video, tmp_path):
    video, truth = demo_video(FRAMES)
    out = tmp_path / "out"
    process = catstream("annotate", video, "--output", out, "--listen", "0", env=os.environ | {"PYTHONUNBUFFERED": "1"})
    link, boxes = process.stdout.readline().strip(), json.dumps([truth[0], truth[-1]])
    lines = run_script(script_of_browser("annotate.mjs", link, boxes, *map(str, SIZE)))
    assert lines[0].startswith("refused 'no name' is not a name: expected")
    assert "proposals 1 forwards,2 backwards,anna" in lines
    assert {"objects anna,ben", "changed [1,10,8,0]"} <= {*lines}
    assert [line for line in lines if line.startswith("violations")] == ["violations light []", "violations dark []"]
    assert [line for line in lines if line.startswith("overflow")] == ["overflow 0", "overflow 0"]
    assert lines[-1] == "errors []"
    assert process.wait(500) == 0
    with (out / "keyframes.csv").open() as file:
        drawn = {(row["object"], int(row["frame"])): row["x"] for row in csv.DictReader(file)}
    assert {*drawn} == {("anna", 0), ("anna", FRAMES - 1), ("carl", 0), ("carl", FRAMES - 1)}
    assert float(drawn["anna", 0]) == pytest.approx(truth[0].x, abs=1)
    assert (out / "demo.csv").read_text().count(",carl,") == FRAMES


def test_several_videos_are_annotated_one_after_the_other(script_of_browser, catstream, succeed, demo_video, tmp_path):
    video, truth = demo_video(FRAMES)
    (tmp_path / "monday").mkdir()
    for name in ("monday/walk.mp4", "monday/run10.mp4", "monday/run9.mp4", "walk.mp4"):
        (tmp_path / name).write_bytes(video.read_bytes())
    (tmp_path / "monday" / "broken.mp4").write_bytes(video.read_bytes()[:1000])
    out = tmp_path / "out"
    words = ["annotate", tmp_path / "monday", tmp_path / "walk.mp4", "--output", out, "--listen", "0"]
    process = catstream(*words, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    link = process.stdout.readline().strip()
    assert run_script(script_of_browser("videos.mjs", link, *map(str, SIZE), json.dumps(truth[0]))) == [
        "first run9, 1 of 4",
        f"videos run9,run10,monday_walk,{tmp_path.name}_walk 1",
        "errors []",
    ]
    _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors
    assert "broken.mp4' is not a video that can be read" in errors
    logs = {log.parent.name: log.read_text() for log in out.glob("*/*.csv") if log.stem.startswith("run")}
    assert logs["run9-annotation"].count(",anna,") == logs["run10-annotation"].count(",ben,") == FRAMES

    succeed("batch", out / "run9-annotation" / "keyframes.csv", "--output", tmp_path / "again", "--jobs", 1)
    assert (tmp_path / "again" / "monday_run9.csv").read_text().count(",anna,") == FRAMES
