"""No process imports anything while it tracks: an import takes processor time from the frames."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from catstream.pipeline import Pipeline
from catstream.services import start_server
from catstream.settings import Settings

#: Logs each import of a process: its process id, the moment, and the module.
HOOK = """
import os, sys, time
def log(event, arguments):
    if event == "import":
        with open({file!r}, "a") as file:
            print(os.getpid(), time.monotonic(), arguments[0], file=file)
sys.addaudithook(log)
"""
TRACKER = """
import sys, cv2, catstream
video, tracker = cv2.VideoCapture(sys.argv[1]), catstream.Tracker()
tracker.init(video.read()[1], sys.argv[2])
tracker.update(video.read()[1])
before = set(sys.modules)
while (read := video.read())[0]:
    tracker.update(read[1])
print(tracker.track.frame, *(set(sys.modules) - before))
"""


@pytest.fixture(scope="module")
def long(demo_video):
    """A video of 300 frames: many samples, and the motion is learned several times."""
    return demo_video(300)


def test_the_processes_of_a_pipeline_import_nothing_after_the_first_frame(long, tmp_path, monkeypatch):
    path, boxes = long
    file = tmp_path / "imports"
    command = start_server.python_command
    monkeypatch.setattr(start_server, "_servers", [])
    monkeypatch.setattr(
        start_server, "python_command", lambda program: command(f"exec({HOOK.format(file=str(file))!r}); {program}")
    )
    with Pipeline(path, boxes[0], Settings(run={"lag_frames": 1})) as pipeline:
        names = {pid: name for name, pid in pipeline.pids.items()}
        tracks = iter(pipeline)
        next(tracks)
        first = time.monotonic()
        assert sum(1 for _ in tracks) == 299
    start_server.start_server().close()
    imports = [line.split() for line in file.read_text().splitlines()]
    assert any(module == "scipy.linalg" for _, _, module in imports), "the hook sees what the server imports"
    assert [
        (names[int(pid)], module) for pid, moment, module in imports if int(pid) in names and float(moment) > first
    ] == []


def test_a_tracker_imports_nothing_after_the_first_frames(long):
    path, boxes = long
    command = [sys.executable, "-c", TRACKER, path, ",".join(map(str, boxes[0]))]
    assert subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout == "299\n"
