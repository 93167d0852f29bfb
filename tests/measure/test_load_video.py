"""The video of a load test: a recording is sent as it is if a camera could have sent it, and encoded otherwise."""

from pathlib import Path

import av
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.errors import ObjectError, SettingsError, VideoError
from catstream.measure import load_video
from catstream.measure.load_result import Plan
from catstream.measure.load_video import prepare, with_recording
from catstream.video.writer import VideoWriter

BOX = Box(10.0, 10.0, 20.0, 20.0)


@pytest.fixture
def recording(image, tmp_path):
    """Writes frames of noise at these times, with B-frames or without."""

    def made(times, b_frames=0):
        path = tmp_path / "recording.mp4"
        if not b_frames:
            with VideoWriter(path, 20.0, (240, 200)) as video:
                for time in times:
                    video.write(np.roll(image, round(time * 20), axis=1), time)
            return str(path)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=20, options={"bf": "2", "x264-params": "b-adapt=0"})
            stream.width, stream.height = 240, 200
            for number in range(len(times)):
                frame = av.VideoFrame.from_ndarray(np.roll(image, number, axis=1), format="bgr24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        return str(path)

    return made


@pytest.fixture
def unloaded(monkeypatch):
    """Replaces the unloaded run by boxes whose x is the number of the frame, and returns the units of each run."""
    runs = []

    def run(_, units, __):
        runs.append(units)
        return [(float(number), 0.0, 1.0, 1.0) for number in range(len(units))]

    monkeypatch.setattr(load_video, "_unloaded_run", run)
    return runs


@pytest.mark.parametrize("b_frames", [0, 2])
def test_recording_is_encoded_only_with_b_frames(recording, unloaded, b_frames):
    path = recording(np.arange(12) / 20, b_frames)
    plan = with_recording(Plan(video=path, boxes={"": BOX}, source="h264"), None)
    assert (plan.size, plan.rate, plan.objects) == ((240, 200), 20.0, 1)
    video = prepare(plan, 30, print)
    with av.open(path) as container:
        sizes = [packet.size for packet in container.demux(video=0) if packet.size]
    own = [len(unit) - 4 for unit in video.units[1:]]  # the first one has the parameters in front of it
    assert (own == [size - 4 for size in sizes[1:]]) == (b_frames == 0)
    assert len(video.units) == 12
    assert unloaded == [video.still + video.units * 2]
    assert video.truth[:, 0].tolist() == [*range(24, 48)]


def test_rate_of_the_load_may_differ_from_the_recording(recording):
    plan = Plan(video=recording([0.0, 0.05, 0.1]), boxes={"": BOX})
    assert with_recording(plan, 5.0).rate == 5.0


@pytest.mark.usefixtures("unloaded")
def test_variable_frame_rate_is_reported(recording, caplog):
    plan = with_recording(Plan(video=recording([0.0, 0.05, 0.1, 0.3, 0.35]), boxes={"": BOX}), None)
    prepare(plan, 5, print)
    assert "variable frame rate" in caplog.text


def test_object_that_the_unloaded_run_never_finds_is_an_error(recording, monkeypatch):
    monkeypatch.setattr(load_video, "_unloaded_run", lambda _, units, __: [(np.nan,) * 4] * len(units))
    plan = with_recording(Plan(video=recording([0.0, 0.05]), boxes={"": BOX}), None)
    with pytest.raises(SettingsError, match="has not found the object"):
        prepare(plan, 5, print)


@pytest.mark.parametrize(
    ("facts", "kind", "message"),
    [
        ({}, ObjectError, "no object to track"),
        ({"boxes": {"": BOX._replace(x=900.0)}}, ValueError, "outside the frame"),
        ({"models": {"": Path("none.model")}}, SettingsError, "--model: there is no saved model"),
        ({"video": "rtsp://camera/1", "boxes": {"": BOX}}, VideoError, "is a live source"),
        ({"times": [0.0], "boxes": {"": BOX}}, VideoError, "expected a video with two frames or more"),
    ],
)
def test_unusable_recording_is_an_error(recording, facts, kind, message):
    video = recording(facts.pop("times", [0.0, 0.05]))
    with pytest.raises(kind, match=message):
        with_recording(Plan(**{"video": video, **facts}), None)
