"""A running pipeline is told what to do: another object, a pause, the end; and begins with what was saved."""

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

#: A small window keeps the detector near the frame that a test has reached.
SETTINGS = Settings(run={"unstored_frames": 16})
SECONDS = 500  # that an answer may take on a busy machine
PATCH = (20, 150, 70, 60)  # of the lake, which the object does not come to


@contextmanager
def steered(source, box=None, **options):
    """A pipeline, its steering, and somewhere to steer from while its tracks are taken."""
    with (
        Pipeline(source, box, SETTINGS, **options) as pipeline,
        control(pipeline.endpoint, timeout=SECONDS) as steering,
        ThreadPoolExecutor(1) as pool,
    ):
        yield pipeline, steering, pool


def with_model(pipeline):
    """The tracks up to the first one that a fourth model gave."""
    tracks = []
    for track in pipeline:
        tracks.append(track)
        if track.model_version >= 4:
            break
    return tracks


def taken(pipeline, tracks, answer):
    """What a command is answered while tracks are taken: few, also if the command takes long to arrive."""
    for track in pipeline:
        tracks.append(track)
        if wait([answer], timeout=2).done:
            break
    return answer.result()


def told(pipeline, condition):
    """The counters of the detector, once they are so."""
    with subscribe(pipeline.endpoint, "health", timeout=SECONDS) as health:
        return next(h.counters for h in health if h.process == "detector" and condition(h.counters))


@pytest.fixture(scope="module")
def saved(long_video, once):
    """What was learned in the first part of a video."""

    def save(folder):
        path, boxes = long_video
        with steered(path, boxes[0]) as (pipeline, steering, _):
            next(track for track in pipeline if track.model_version >= 4)
            assert steering.save(folder / "object.safetensors").version >= 4

    return once("saved", save) / "object.safetensors"


def test_set_box_replaces_the_object_from_its_frame_on_if_processes_die(long_video):
    path, boxes = long_video
    with steered(path, PATCH) as (pipeline, steering, pool):
        tracks = with_model(pipeline)
        wanted = boxes[len(tracks) + SETTINGS.run.unstored_frames]  # the detector is as far ahead
        answer = taken(pipeline, tracks, pool.submit(steering.set_box, wanted))
        for victim in ("detector", "compressor"):
            os.kill(pipeline.pids[victim], signal.SIGKILL)
        tracks += pipeline
    assert [track.frame for track in tracks] == list(range(len(boxes)))
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(boxes), len(boxes))
    before, after = tracks[: answer.frame], tracks[answer.frame :]
    assert (after[0].state, after[0].model_version) == ("bootstrapping", 0)
    assert after[0].box == pytest.approx(wanted)
    assert not any(track.box is not None and track.box.overlap(boxes[track.frame]) for track in before)
    there = [track.box is not None and track.box.overlap(boxes[track.frame]) > 0.3 for track in after]
    assert sum(there) > 0.8 * len(after)
    newest = max(track.model_version for track in before)
    assert after[-1].model_version > newest
    assert all(track.model_version == 0 or track.model_version > newest for track in after)


def test_paused_live_source_skips_frames(video, camera):
    path, boxes = video
    with open_source(path) as source:
        image = next(source).image
    still = camera(lambda _: image)
    with steered(still.url) as (pipeline, steering, _):
        told(pipeline, lambda counters: counters["waiting"] and counters["skipped"] >= 3)
        steering.set_box(boxes[0])
        steering.pause()
        passed = told(pipeline, lambda counters: counters["paused"])
        assert told(pipeline, lambda counters: counters["skipped"] > passed["skipped"])["sent"] == passed["sent"]
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
def test_search_gives_the_tracks_of_one_process_if_processes_die(video, saved, victims):
    path, settings = video[0], Settings(run={"lockstep": True, "unstored_frames": 4})
    tracks = []
    with (
        Pipeline(path, {"ben": PATCH}, settings) as pipeline,
        control(pipeline.endpoint, timeout=SECONDS) as steering,
        ThreadPoolExecutor(1) as pool,
    ):
        tracks.append(next(iter(pipeline)))
        assert taken(pipeline, tracks, pool.submit(steering.search, saved, "anna")).done
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
