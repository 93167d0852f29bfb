"""Commands to a running pipeline: pause, resume, stop, save and search."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager

import pytest

from catstream.base.settings import Settings
from catstream.client.attach import control, subscribe
from catstream.client.saved_model import SavedModel
from catstream.multi import MultiTracker
from catstream.pipeline import Pipeline
from catstream.video.source import open_source
from tests.learning import learned_from

#: A small window keeps the detector near the frame that a test has reached.
SETTINGS = Settings(run={"unstored_frames": 16})
SECONDS = 500  # that an answer may take on a busy machine
PATCH = (20, 150, 70, 60)  # of the lake, which the object does not come to


@contextmanager
def steered(source, box=None, settings=SETTINGS):
    """A pipeline and its control."""
    with Pipeline(source, box, settings) as pipeline, control(pipeline.endpoint, timeout=SECONDS) as steering:
        yield pipeline, steering


def answered(pipeline, tracks, answer):
    """The answer to a command; few tracks are received while it is awaited."""
    for track in pipeline:
        tracks.append(track)
        if wait([answer], timeout=2).done:
            break
    return answer.result()


def counters_of(pipeline, condition):
    """The counters of the detector, once they fulfil a condition."""
    with subscribe(pipeline.endpoint, "health", timeout=SECONDS) as health:
        return next(h.counters for h in health if h.process == "detector" and condition(h.counters))


@pytest.fixture(scope="module")
def saved(long_video, tmp_path_factory):
    """A model of the object in the first part of a video."""
    file = tmp_path_factory.mktemp("saved") / "object.safetensors"
    learned_from(long_video[0], long_video[1][0], slice(0, 40)).save(file)
    return file


def test_paused_live_source_skips_frames(video, camera):
    path, boxes = video
    with open_source(path) as source:
        image = next(source).image
    still = camera(lambda _: image)
    with steered(still.url) as (pipeline, steering):
        counters_of(pipeline, lambda counters: counters["waiting"] and counters["skipped"] >= 3)
        steering.set_box(boxes[0])
        steering.pause()
        passed = counters_of(pipeline, lambda counters: counters["paused"])
        assert counters_of(pipeline, lambda counters: counters["skipped"] > passed["skipped"])["sent"] == passed["sent"]
        steering.resume()
        tracks = []
        for track in pipeline:
            tracks.append(track)
            if len(tracks) == passed["sent"] + 3:
                steering.stop()
    assert tracks[0].box == pytest.approx(boxes[0])
    assert [(track.frame, track.source_frame) for track in tracks] == [(n, n) for n in range(len(tracks))]
    assert all(track.box.overlap(boxes[0]) > 0.8 for track in tracks)
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(tracks), len(tracks))
    assert pipeline.totals["skipped"] > passed["skipped"]


@pytest.mark.parametrize("victims", [(), ("detector", "compressor", "trainer")], ids=str)
def test_search_gives_the_tracks_of_one_process(video, saved, victims):
    path, settings = video[0], Settings(run={"lockstep": True, "unstored_frames": 4})
    tracks = []
    with steered(path, {"ben": PATCH}, settings) as (pipeline, steering), ThreadPoolExecutor(1) as pool:
        tracks.append(next(iter(pipeline)))
        assert answered(pipeline, tracks, pool.submit(steering.search, saved, "anna")).done
        for victim in victims:
            os.kill(pipeline.pids[victim], signal.SIGKILL)
        tracks += pipeline
        assert pipeline.restarts >= len(victims)
    assert [track.frame for track in tracks if track.object == "ben"] == list(range(len(video[1])))
    assert pipeline.totals["stored"] == len(video[1])
    assert tracks[-1].object == "anna"
    if victims:  # after a restart the search may begin too late in this short video for three sightings
        return
    expected, learned, tracker = [], SavedModel.load(saved), MultiTracker()
    began = next(track.began for track in tracks if track.object == "anna")
    with open_source(path) as source:
        for frame in source:
            if expected:
                search = {"anna": learned} if frame.number == began else None
                tracker.update(frame.image, time=frame.time, search=search)
            else:
                tracker.init(frame.image, {"ben": PATCH}, frame.time)
            expected += tracker.tracks.values()
    assert tracks == expected
    assert tracks[-1].box.overlap(video[1][-1]) > 0.5
