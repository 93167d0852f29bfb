"""A run with a network: the same tracks in one process and in three, whoever dies; other files are refused."""

import os
import shutil
import signal

import onnx
import pytest

from catstream.errors import SettingsError
from catstream.finding.find import find
from catstream.jobs.saved_model import SavedModel, merge
from catstream.multi import MultiTracker
from catstream.pipeline import Pipeline
from catstream.tracker import Tracker
from catstream.video.source import open_source

PATCH = (20, 150, 70, 60)  # of the picture's lake


@pytest.fixture
def net(network, tmp_path):
    """A network of this test alone."""
    return shutil.copy(network / "net.onnx", tmp_path / "net.onnx")


@pytest.fixture(scope="module")
def settings(network):
    return {"features.network": str(network / "net.onnx"), "run.lockstep": True}


@pytest.fixture(scope="module")
def objects(video):
    return {"anna": video[1][0], "ben": PATCH}


@pytest.fixture(scope="module")
def expected(video, objects, settings):
    """The tracks in one process, and what was learned of an object by then."""
    tracker, tracks = MultiTracker(settings), []
    with open_source(video[0]) as source:
        for frame in source:
            if tracks:
                tracker.update(frame.image, time=frame.time)
            else:
                tracker.init(frame.image, objects, frame.time)
            tracks += tracker.tracks.values()
    return tracks, tracker.saved_model("anna")


@pytest.fixture(scope="module")
def saved(expected, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "anna.safetensors"
    expected[1].save(path)
    return path


def another(net):
    """Change the file so that it computes the same, with another digest."""
    model = onnx.load(net)
    model.producer_name = "another"
    onnx.save(model, net)


def test_in_lockstep_tracks_are_as_in_one_process_whoever_dies(video, objects, expected, settings):
    victims, tracks = {5: "detector", 12: "compressor", 20: "trainer"}, []
    with Pipeline(video[0], objects, settings) as pipeline:
        for each in pipeline.by_frame():
            tracks += each.values()
            if victim := victims.get(len(tracks) // 2):
                os.kill(pipeline.pids[victim], signal.SIGKILL)
        assert pipeline.restarts == len(victims)
    assert tracks == expected[0]


def test_a_run_is_resumed_with_its_network_and_not_with_another_file(video, objects, expected, settings, net, tmp_path):
    settings = settings | {"features.network": str(net)}
    tracks = []
    with Pipeline(video[0], objects, settings, state=tmp_path / "kept") as pipeline:
        for each in pipeline.by_frame():
            tracks += each.values()
            if len(tracks) == 20:
                break
    shutil.copy(net, tmp_path / "copy.onnx")
    another(net)
    with pytest.raises(SettingsError, match="was started with a network of digest"):
        Pipeline(resume=tmp_path / "kept")
    with pytest.raises(SettingsError, match=r"was started with features.network="):
        Pipeline(resume=tmp_path / "kept", settings={"features.network": str(tmp_path / "copy.onnx")})
    shutil.copy(tmp_path / "copy.onnx", net)
    tracks += Pipeline(resume=tmp_path / "kept", after=9)
    for track, each in zip(tracks, expected[0], strict=True):
        assert (track.object, track.frame) == (each.object, each.frame)
        # The checkpoint may be ahead of the tracks that were read: these frames are tracked again with a newer model.
        assert track.box.overlap(each.box) > 0.8


def test_a_saved_model_is_searched_for_and_found_with_its_network_only(video, saved, settings, net):
    tracks = list(Pipeline(video[0], settings=settings, model=saved))
    assert tracks[-1].box.overlap(video[1][-1]) > 0.5
    best = max(find(saved, video[0], network=settings["features.network"]), key=lambda each: each.score)
    assert best.box.overlap(video[1][best.frame]) > 0.5
    another(net)
    for network in ("", str(net)):
        with pytest.raises(SettingsError, match=r"was trained with the network of digest \w+, this run has"):
            Pipeline(video[0], settings={"features.network": network}, model=saved)
        with pytest.raises(SettingsError, match=r"was trained with the network of digest \w+, this search has"):
            find(saved, video[0], network=network)


def test_saved_models_of_one_network_are_merged_and_of_two_are_not(video, expected, settings, net, saved):
    path, boxes = video

    def learned(settings):
        tracker = Tracker(settings)
        with open_source(path, part=slice(0, 20)) as source:
            for frame in source:
                tracker.update(frame.image) if frame.number else tracker.init(frame.image, boxes[0].scaled(1.02))
        return tracker.saved_model()

    one = SavedModel.load(saved)
    assert one.to_bytes() == expected[1].to_bytes()
    whole = merge([one, learned(settings)])
    assert (whole.model.network, len(whole.model.weights)) == (one.model.network, len(one.model.weights))
    another(net)
    with pytest.raises(SettingsError, match=r"trained with the network of digest \w+, another with the network of"):
        merge([one, learned(settings | {"features.network": str(net)})])
    with pytest.raises(SettingsError, match="another with no network"):
        merge([one, learned({})])
