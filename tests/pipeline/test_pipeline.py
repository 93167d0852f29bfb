"""The three processes on a real video, from the first frame to the last."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.errors import ServiceError, VideoError
from catstream.multi import MultiTracker
from catstream.pipeline import Pipeline
from catstream.processes.start_server import NAMES
from catstream.video.source import open_source
from catstream.wire.keys import create

#: A small window keeps the detector near the frame that a test has reached.
SETTINGS = Settings(run={"unstored_frames": 16})


@pytest.fixture(scope="module")
def in_one_process(video):
    """The boxes of three objects in the first frame, and their tracks in one process, frame by frame."""
    boxes = {"anna": video[1][0], "ben": (20, 150, 70, 60), "carl": (20, 20, 60, 60)}
    tracker, tracks = MultiTracker(), []
    with open_source(video[0]) as source:
        for frame in source:
            if frame.number:
                tracker.update(frame.image, time=frame.time)
            else:
                tracker.init(frame.image, boxes, frame.time)
            tracks.append(tracker.tracks)
    return boxes, tracks


@pytest.mark.parametrize("victims", [{}, {5: "detector", 12: "compressor", 20: "trainer"}], ids=["none", "each"])
def test_lockstep_gives_the_tracks_of_one_process(video, in_one_process, folder, tcp, victims):
    create(folder / "keys")
    # The detector has not reached the end of the video when the last process is killed.
    run = {"lockstep": True, "keys": str(folder / "keys"), "endpoint": tcp, "unstored_frames": 4}
    settings = Settings(run=run)
    (boxes, expected), tracks = in_one_process, []
    with Pipeline(video[0], boxes, settings) as pipeline:
        for each in pipeline.by_frame():
            tracks.append(each)
            if victim := victims.get(len(tracks)):
                os.kill(pipeline.pids[victim], signal.SIGTERM if victim == "trainer" else signal.SIGKILL)
        assert pipeline.restarts >= len(victims)
    if not victims:
        assert tracks == expected
    assert [[*each] for each in tracks] == [[*each] for each in expected]
    assert pipeline.totals["sent"] == pipeline.totals["stored"] == len(expected)


def test_part_is_tracked_whole_if_the_detector_dies(long_video):
    path, boxes = long_video
    part = slice(10, 60, 2)
    wanted, tracks = range(len(boxes))[part], []
    with Pipeline(path, boxes[10], SETTINGS, part=part) as pipeline:
        for track in pipeline:
            tracks.append(track)
            if track.frame == 15:
                os.kill(pipeline.pids["detector"], signal.SIGKILL)
        assert pipeline.frames == len(wanted)
    assert [track.frame for track in tracks] == list(range(len(wanted)))
    assert [track.time for track in tracks] == pytest.approx([number / 30 for number in wanted], abs=0.002)


FORKS = """
import gc, os, sys, catstream

def copied():
    if not (child := os.fork()):
        return True
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))

codes = []
with catstream.Pipeline(sys.argv[1], sys.argv[2]) as pipeline, catstream.subscribe(pipeline.endpoint, "tracks") as sub:
    tracks = iter(pipeline)
    first = next(tracks)
    with catstream.control(pipeline.endpoint) as control:
        if copied():
            sys.exit(7)
        if copied():
            raise KeyError("in the copy")
        if copied():
            for use in (lambda: next(tracks), lambda: pipeline.pids, lambda: next(sub), control.pause):
                try:
                    use()
                    os._exit(1)
                except catstream.CatstreamError as error:
                    assert "fork" in str(error)
            use = tracks = pipeline = None
            gc.collect()
            os._exit(7)
    complete = {'job.safetensors', 'lock', 'endpoint', 'results'} <= {*os.listdir(pipeline.endpoint)}
    print(*codes, complete, 1 + len([*tracks]), pipeline.totals["restarts"])
"""


def test_forked_copy_of_a_program_changes_nothing_of_its_run(video):
    """One that exits, one that fails, and one that uses what it inherited."""
    path, boxes = video
    command = [sys.executable, "-c", FORKS, path, ",".join(map(str, boxes[0]))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.stdout.split() == ["7", "1", "7", "True", str(len(boxes)), "0"], done.stderr


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_second_pipeline_at_the_same_endpoint_is_rejected(video, transport, folder, tcp):
    path, boxes = video
    settings = Settings(run={"endpoint": str(folder) if transport == "ipc" else tcp, "unstored_frames": 16})
    with Pipeline(path, boxes[0], settings) as first:
        with (
            pytest.raises(ServiceError, match=r"(use|choose) another (endpoint|folder)"),
            Pipeline(path, boxes[0], settings),
        ):
            pass
        assert set(first.pids) == set(NAMES), "the first one goes on"
    with Pipeline(path, boxes[0], settings) as next_one:
        assert next(iter(next_one)).frame == 0, "the place is free at once"


def test_frames_in_memory_are_an_error_that_names_the_tracker():
    message = r"the number of a camera, got \w+: pass frames in memory to catstream.Tracker"
    with pytest.raises(VideoError, match=message):
        Pipeline(np.zeros((9, 9, 3), np.uint8), (0, 0, 10, 10))
