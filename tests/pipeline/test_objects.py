"""Several objects through the three processes: they are tracked as in one process, come and go, and are resumed."""

import os
import signal
from pathlib import Path

import pytest

from catstream.base.settings import Settings
from catstream.client.attach import control
from catstream.multi import MultiTracker
from catstream.pipeline import Pipeline
from catstream.video.source import open_source
from catstream.wire.keys import create

FRAMES = 30
PATCHES = {"ben": (20, 150, 70, 60), "carl": (20, 20, 60, 60)}  # of the picture's lake
SETTINGS = Settings(run={"unstored_frames": 16})


@pytest.fixture(scope="module")
def objects(video):
    """The boxes of three objects in the first frame, by name."""
    return {"anna": video[1][0], **PATCHES}


@pytest.fixture(scope="module")
def expected(video, objects):
    """The tracks of each frame in one process."""
    tracker, tracks = MultiTracker(), []
    with open_source(video[0]) as source:
        for frame, _ in zip(source, range(FRAMES), strict=False):
            if tracks:
                tracker.update(frame.image, time=frame.time)
            else:
                tracker.init(frame.image, objects, frame.time)
            tracks.append(tracker.tracks)
    return tracks


@pytest.mark.parametrize("victims", [{}, {5: "detector", 12: "compressor", 20: "trainer"}], ids=["none", "each"])
def test_lockstep_gives_the_tracks_of_one_process_if_processes_die(video, objects, expected, folder, tcp, victims):
    create(folder / "keys")
    settings = Settings(run={"lockstep": True, "keys": str(folder / "keys"), "endpoint": tcp})
    tracks = []
    with Pipeline(video[0], objects, settings, part=slice(0, FRAMES)) as pipeline:
        for each in pipeline.by_frame():
            tracks.append(each)
            if victim := victims.get(len(tracks)):
                os.kill(pipeline.pids[victim], signal.SIGKILL)
        assert pipeline.restarts == len(victims)
    if not victims:
        assert tracks == expected
    assert [[*each] for each in tracks] == [[*each] for each in expected]
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (FRAMES, FRAMES)


def test_a_run_that_is_resumed_has_the_objects_that_it_had_and_each_frame_once(video, objects, tmp_path):
    tracks = []
    with (
        Pipeline(video[0], objects, SETTINGS, part=slice(0, FRAMES), state=tmp_path / "kept") as pipeline,
        control(Path(pipeline.endpoint), timeout=150) as steering,
    ):
        frames = pipeline.by_frame()
        tracks.append(next(frames))
        last = steering.forget("ben").frame  # the detector waits: its window is full before the last frame
        while "ben" in tracks[-1]:
            tracks.append(next(frames))
    with Pipeline(resume=tmp_path / "kept", settings=SETTINGS, after=len(tracks) - 1) as pipeline:
        tracks += pipeline.by_frame()
    assert [each["anna"].frame for each in tracks] == list(range(FRAMES))
    assert [frame for frame, each in enumerate(tracks) if "ben" in each] == list(range(last + 1))
    assert all(each.keys() >= {"anna", "carl"} for each in tracks)
