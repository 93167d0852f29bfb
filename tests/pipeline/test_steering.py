"""A running pipeline is told what to do: another object, a pause, the end; and begins with what was saved."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path

import cv2
import pytest
import zmq

from catstream.base.settings import Settings
from catstream.client.attach import control, subscribe
from catstream.errors import (
    BoxError,
    CommandRejectedError,
    ObjectError,
    ProtocolError,
    ServiceError,
    SettingsError,
    SilenceError,
)
from catstream.jobs.saved_model import SavedModel
from catstream.multi import MultiTracker
from catstream.pipeline import Pipeline
from catstream.processes.decisions import DesiredState
from catstream.video.source import open_source
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint
from tests.pipeline.conftest import share_found

#: A small window keeps the detector near the frame that a test has reached.
SETTINGS = Settings(run={"unstored_frames": 16})
SECONDS = 60  # that an answer may take on a busy machine
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


def test_boxes_of_several_objects_begin_in_the_same_frame_or_none(video):
    path, boxes = video
    together = {"anna": boxes[0], "ben": (20, 150, 70, 60)}
    with steered(path) as (pipeline, steering, _):
        steering.pause()
        with pytest.raises(CommandRejectedError, match=r"ben: .*outside"):
            steering.set_boxes(together | {"ben": (4000, 10, 20, 20)})
        answer = steering.set_boxes(together)
        assert (answer.frame, answer.reason) == (0, "anna, ben begin in frame 0")
        steering.stop()
        tracks = list(pipeline)
    assert [(track.object, track.frame, track.box) for track in tracks] == [
        (name, 0, pytest.approx(box)) for name, box in together.items()
    ]


def test_the_first_frame_waits_for_a_box_and_in_a_pause_a_box_is_for_the_waiting_one(video):
    path, boxes = video
    with steered(path) as (pipeline, steering, _):
        assert told(pipeline, lambda counters: counters["waiting"])["sent"] == 0
        steering.pause()
        refuses_what_cannot_be_done(pipeline, steering)
        assert steering.set_box(boxes[0]).frame == 0
        assert steering.set_box(boxes[1]).frame == 1
        told(pipeline, lambda counters: counters["paused"] and counters["sent"] == 2)
        steering.resume()
        tracks = list(pipeline)
        assert pipeline.restarts == 0
    assert [track.frame for track in tracks] == list(range(len(boxes)))
    assert [track.box for track in tracks[:2]] == [pytest.approx(box) for box in boxes[:2]]
    assert share_found(tracks, boxes) > 0.8
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(boxes), len(boxes))


def refuses_what_cannot_be_done(pipeline, steering):
    """A pipeline that has no box yet says why, and counts what is no command."""
    with pytest.raises(CommandRejectedError, match="outside the frame"):
        steering.set_box((400, 10, 20, 20))
    with pytest.raises(BoxError, match="at least 2 pixels"):
        steering.set_box((10, 10, 1, 9))
    for command in (steering.forget, lambda: steering.save("never.safetensors")):
        with pytest.raises(CommandRejectedError, match="no object is tracked yet"):
            command()
    with pytest.raises(ObjectError, match="is not a name"):
        steering.set_box((10, 10, 20, 20), "an na")
    with zmq.Context.instance().socket(zmq.DEALER) as stranger:
        stranger.connect(Endpoint.parse(pipeline.endpoint).address(CHANNELS["control"]))
        for data in (b"", b"\xc1", b"\x93\x01\xa4", bytes(9000)):
            stranger.send(data)
        told(pipeline, lambda counters: counters["rejected"] >= 4)


def test_another_object_replaces_the_first_from_its_frame_on_whichever_process_dies(long_video):
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


def test_a_moved_object_keeps_its_model_and_a_stop_command_stores_all(long_video):
    path, boxes = long_video
    with steered(path, boxes[0]) as (pipeline, steering, pool):
        tracks = with_model(pipeline)
        answer = taken(pipeline, tracks, pool.submit(steering.set_box, boxes[len(tracks)], keep=True))
        taken(pipeline, tracks, pool.submit(steering.stop))
        tracks += pipeline
    assert answer.frame < len(tracks) < len(boxes)
    assert [track.frame for track in tracks] == list(range(len(tracks)))
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(tracks), len(tracks))
    corrected = tracks[answer.frame]
    assert corrected.state == "present"
    assert corrected.box == pytest.approx(boxes[corrected.frame - 1], abs=60)
    assert corrected.model_version >= 4
    versions = [track.model_version for track in tracks]
    assert versions == sorted(versions)


def test_a_detector_that_dies_while_paused_is_restarted_paused(video):
    path, boxes = video
    with steered(path) as (pipeline, steering, pool):
        steering.pause()
        steering.set_box(boxes[0])
        killed = pipeline.pids["detector"]
        os.kill(killed, signal.SIGKILL)
        resumed = pool.submit(lambda: (told(pipeline, lambda counters: counters["paused"]), steering.resume()))
        tracks = list(pipeline)
        assert resumed.result()[0]["sent"] <= 1
    assert pipeline.restarts == 1
    assert [track.frame for track in tracks] == list(range(len(boxes)))


@pytest.mark.parametrize("torn", ["", "{", "null", '{"objects": {"": [1, 2]}}'], ids=repr)
def test_commands_that_a_power_cut_tore_are_an_error(tmp_path, torn):
    (tmp_path / "desired_state.json").write_text(torn)
    with pytest.raises(ProtocolError, match="cannot read the desired state"):
        DesiredState.load(tmp_path / "desired_state.json")


def test_an_incomplete_file_of_commands_is_reported_and_the_run_continues(video, tmp_path):
    path, boxes = video
    settings = SETTINGS.replace({"run.lockstep": True})  # the video does not end before the second model
    with Pipeline(path, boxes[0], settings, state=tmp_path / "kept") as pipeline:
        before = next(track for track in pipeline if track.model_version >= 2)
    (tmp_path / "kept" / "desired_state.json").write_text("{")
    with Pipeline(resume=tmp_path / "kept", settings=settings) as pipeline:
        tracks = list(pipeline)
    assert "cannot read the desired state" in pipeline.trouble["detector"]
    assert pipeline.restarts == 0
    assert 0 < tracks[0].frame <= before.frame + SETTINGS.run.unstored_frames
    assert tracks[0].model_version > 0, "what was learned is whole"
    assert tracks[-1].frame == len(boxes) - 1


def test_commands_are_on_disk_before_they_take_the_place_of_older_ones(tmp_path, monkeypatch):
    done = []
    for module, name in ((os, "fsync"), (Path, "replace")):
        call = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, call=call, name=name: (done.append(name), call(*given))[1])
    DesiredState(paused=True).save(tmp_path / "desired_state.json")
    assert done == ["fsync", "replace", "fsync"], "the file, and then its name"
    assert DesiredState.load(tmp_path / "desired_state.json") == DesiredState(paused=True)


def test_a_saved_model_finds_the_object_and_learning_continues_from_it(long_video, saved):
    path, boxes = long_video
    version = SavedModel.load(saved).model.version
    soon = Settings(run={"lag_frames": 5})  # the part is shorter than the lag that the default allows
    with Pipeline(path, settings=soon, model=saved, part=slice(40, None)) as pipeline:
        tracks = list(pipeline)
    assert tracks[0].model_version == version
    assert "bootstrapping" not in {track.state for track in tracks}
    assert share_found(tracks, boxes[40:]) > 0.8
    versions = [track.model_version for track in tracks]
    assert versions == sorted(versions)
    assert versions[-1] > version


def test_a_run_from_a_saved_model_goes_on_if_the_detector_dies(video, saved):
    tracks = []
    with Pipeline(video[0], settings={"run.lockstep": True}, model=saved, part=slice(10, 32)) as pipeline:
        for track in pipeline:
            tracks.append(track)
            if track.frame == 8:
                os.kill(pipeline.pids["detector"], signal.SIGKILL)
    assert pipeline.restarts == 1
    assert [track.frame for track in tracks] == list(range(22))
    assert tracks[-1].box.overlap(video[1][31]) > 0.5


def test_the_object_is_absent_until_it_is_found_in_whatever_size(video, saved, rng, tmp_path):
    path, _ = video
    with open_source(path) as source:
        images = [cv2.resize(frame.image, None, fx=1.9, fy=1.9) for frame, _ in zip(source, range(20), strict=False)]
    empty = [rng.integers(0, 256, images[0].shape, "u1") for _ in range(5)]
    for number, image in enumerate(empty + images):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    with Pipeline(str(tmp_path), settings=SETTINGS, model=saved) as pipeline:
        tracks = list(pipeline)
    assert {track.state for track in tracks[:5]} == {"absent"}
    assert tracks[-1].state == "present"
    assert tracks[-1].box.overlap(video[1][19].scaled(1.9).centred(*(1.9 * c for c in video[1][19].centre))) > 0.5


def test_a_pause_with_a_timeout_ends_and_a_new_subscriber_learns_of_the_pause(endless, video):
    with steered(endless, video[1][0]) as (pipeline, steering, _):
        told(pipeline, lambda counters: counters["sent"])
        steering.pause(seconds=600)
        silence = pytest.raises(SilenceError, match="the state of the pipeline is: paused")
        with subscribe(pipeline.endpoint, "tracks", timeout=3) as tracks, silence:
            next(tracks)
        with subscribe(pipeline.endpoint, "health", timeout=SECONDS) as health:
            report = next(each for each in health if each.state == "paused")
        assert report.objects[""].keys() == {"model_version"}, "where it is is not known"
        steering.pause(seconds=0.5)
        told(pipeline, lambda counters: not counters["paused"])
        with subscribe(pipeline.endpoint, "health", timeout=SECONDS) as health:
            report = next(each for each in health if each.state == "running")
        assert report.objects[""].keys() == {"model_version", "score", "present"}


def test_an_object_whose_box_is_of_a_past_picture_begins_where_it_has_moved_to(walker):
    url, find = walker
    with (
        steered(url) as (pipeline, steering, _),
        subscribe(pipeline.endpoint, "previews", timeout=SECONDS) as pictures,
    ):
        drawn = next(pictures)
        box = find(drawn.jpeg)
        next(each for each in pictures if not find(each.jpeg).overlap(box))  # it is elsewhere by now
        answer = steering.set_box(box, time=drawn.time)
        assert answer.reason.endswith("s before frame 0")
        shown = next(each for each in pictures if each.boxes)
        assert shown.boxes[""].overlap(find(shown.jpeg)) > 0.5
        answer = steering.set_box(find(shown.jpeg), "ben", time=1e-6)
        assert answer.reason.endswith("as the picture in which it was drawn is not stored any more")


def test_of_a_live_source_frames_pass_by_while_nothing_is_followed(video, camera):
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
    assert [track.frame for track in tracks] == list(range(len(tracks)))
    assert all(track.box.overlap(boxes[0]) > 0.8 for track in tracks)
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(tracks), len(tracks))
    assert pipeline.totals["skipped"] > passed["skipped"]


def test_a_picture_of_a_live_source_has_the_frame_number_and_the_boxes_of_its_track(video, camera):
    path, boxes = video
    with open_source(path) as source:
        images = [frame.image for frame, _ in zip(source, range(23), strict=False)]
    moving = camera(lambda number: images[number % 23])  # a picture that is the same as the last one is not received
    with (
        steered(moving.url) as (pipeline, steering, _),
        subscribe(pipeline.endpoint, "previews", timeout=SECONDS) as pictures,
    ):
        told(pipeline, lambda counters: counters["waiting"] and counters["skipped"] >= 3)
        assert [next(pictures).frame for _ in range(3)] == [0, 0, 0], "that of the frame that is tracked next"
        steering.set_box(boxes[0])
        picture = next(picture for picture in pictures if picture.boxes)
        track = next(track for track in pipeline if track.frame == picture.frame)
    assert picture.boxes == {"": track.box}


def test_an_unusable_model_is_rejected_before_anything_starts(video, saved, tmp_path):
    path, boxes = video
    torn = tmp_path / "torn"
    torn.write_bytes(saved.read_bytes()[:-9])
    with pytest.raises(ProtocolError, match="not an undamaged file"):
        Pipeline(path, model=torn)
    with pytest.raises(ServiceError, match="no saved model"):
        Pipeline(path, model=tmp_path / "none")
    with pytest.raises(SettingsError, match="box and model of the object without a name are mutually exclusive"):
        Pipeline(path, boxes[0], model=saved)
    with pytest.raises(SettingsError, match=r"learned with coreset.size=\d+, this run has coreset.size=5"):
        Pipeline(path, settings={"coreset.size": 5}, model=saved)


@pytest.mark.parametrize("victims", [(), ("detector", "compressor", "trainer")], ids=str)
def test_an_object_is_searched_for_in_a_pipeline_as_in_one_process_whichever_dies(video, saved, victims):
    path, settings = video[0], Settings(run={"lockstep": True})
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


def test_an_object_that_is_searched_for_is_found_after_a_resume_without_the_file(video, saved, tmp_path):
    path, boxes = video
    copy = tmp_path / "anna.safetensors"
    copy.write_bytes(saved.read_bytes())
    with steered(path, state=tmp_path / "kept") as (pipeline, steering, _):
        told(pipeline, lambda counters: counters["waiting"])
        steering.pause()
        assert steering.search(copy, "anna").reason.startswith("anna is searched for from frame 0 on")
    copy.unlink()
    with steered(None, resume=tmp_path / "kept") as (pipeline, steering, _):
        steering.resume()
        tracks = list(pipeline)
    assert [track.frame for track in tracks] == list(range(len(boxes)))
    assert share_found(tracks, boxes) > 0.8
