"""Each example runs once with a real pipeline, or on a real video."""

import base64
import json
import re
import runpy
import select
import shutil
import sqlite3
import subprocess
import sys
from contextlib import ExitStack, closing
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import catstream
from catstream.base.box import Box
from catstream.pipeline import Pipeline
from catstream.video.source import open_source
from catstream.wire.messages import Track

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).parents[1] / "examples"
EACH_FRAME = {"run.unstored_frames": 1}  # the pipeline continues only if its tracks are received


def started(stack, example, *words):
    """The process of an example, which ends with the stack."""
    program = sys.executable if example.endswith(".py") else "node"
    process = stack.enter_context(
        subprocess.Popen([program, EXAMPLES / example, *map(str, words)], stdout=subprocess.PIPE, text=True)
    )
    stack.callback(process.kill)
    return process


@pytest.fixture
def run_with_pipeline(demo_video):
    """Runs an example with a pipeline; returns the tracks by frame, and the output lines of the example."""

    def run(example, *words, keys=""):
        source, boxes = demo_video(60)
        tracks, speaks = {}, False
        with ExitStack() as stack:
            pipeline = stack.enter_context(Pipeline(str(source), boxes[0], EACH_FRAME | {"run.keys": str(keys)}))
            process = started(stack, example, *(pipeline.endpoint if word == "ENDPOINT" else word for word in words))
            for track in pipeline:
                tracks[track.frame] = track
                speaks = speaks or select.select([process.stdout], [], [], 2)[0]  # while it starts, few frames pass
            printed, _ = process.communicate(timeout=500)
        assert process.returncode == 0
        return tracks, printed.splitlines()

    return run


@pytest.mark.parametrize("example", ["subscriber.py", "subscriber.mjs"])
def test_subscriber_prints_tracks_and_models_until_the_end(run_with_pipeline, keys, example):
    modules = [EXAMPLES / "node_modules" / name for name in ("zeromq", "@msgpack/msgpack")]
    if example.endswith(".mjs") and not (shutil.which("node") and all(module.exists() for module in modules)):
        pytest.skip("Node.js or its modules are missing: npm ci --prefix examples")
    found, printed = run_with_pipeline(example, "ENDPOINT", keys, keys=keys)
    assert printed[-1] == "end: the source has ended, 0 tracks missed"
    tracks = [text.split() for text in printed if text.startswith("track ")]
    assert [int(frame) for _, frame, *_ in tracks] == list(range(60 - len(tracks), 60))
    for _, frame, state, box, score in tracks:
        track = found[int(frame)]
        assert (state, float(score)) == (track.state, pytest.approx(track.score, abs=0.001))
        sides = None if box == "-" else [float(side) for side in box.split(",")]
        assert sides == (track.box and pytest.approx(track.box, abs=0.1))
    assert any(text.startswith("model ") for text in printed)


def test_several_objects_prints_when_two_meet(demo_video):
    source, boxes = demo_video(60)
    sky = catstream.Box(boxes[0].x, boxes[0].y - 30, boxes[0].w, 40)  # the lower part of it is on the flower
    with ExitStack() as stack:
        example = started(stack, "several_objects.py", source, f"flower={boxes[0]}", f"sky={sky}")
        first, *_, flower, sky = example.communicate(timeout=500)[0].splitlines()
    assert first == "frame 0: flower and sky meet"
    assert flower == "flower: present in 60 of 60 frames"
    assert re.fullmatch(r"sky: present in \d+ of 60 frames", sky)


def test_summary_of_a_folder_prints_its_images(demo_video, tmp_path):
    with open_source(demo_video(24)[0]) as frames:
        for frame in frames:
            cv2.imwrite(str(tmp_path / f"{frame.number:02d}.png"), frame.image)
    with ExitStack() as stack:
        printed, _ = started(stack, "summarise_images.py", tmp_path, 4).communicate(timeout=500)
    assert printed.count(".png") == 4
    assert "of the energy of all images is kept" in printed


def test_tracks_are_converted_to_detections_of_supervision():
    pytest.importorskip("supervision")
    detections = runpy.run_path(str(EXAMPLES / "to_supervision.py"))["detections"]
    track = Track(0, 0.0, "present", catstream.Box(1, 2, 3, 4), 1.5, 0, object="anna")
    found = detections([track, Track(0, 0.0, "absent", None, 0.1, 0, object="ben")])
    np.testing.assert_array_equal(found.xyxy, [[1, 2, 4, 6]])
    assert len(detections([])) == 0


def test_ground_station_selects_an_object_and_receives_its_box(demo_video, monkeypatch):
    pytest.importorskip("pymavlink", reason="pymavlink is missing: pip install pymavlink")
    monkeypatch.setenv("MAVLINK20", "1")
    mavlink, mavutil = import_module("pymavlink.dialects.v20.common"), import_module("pymavlink.mavutil")
    source, boxes = demo_video(60)
    with ExitStack() as stack:
        link = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255, dialect="common")
        stack.callback(link.close)
        pipeline = stack.enter_context(Pipeline(str(source), settings=EACH_FRAME))
        address = f"udpout:127.0.0.1:{link.port.getsockname()[1]}"
        camera = started(stack, "mavlink_gimbal.py", pipeline.endpoint, "--link", address)

        def result_of(name, *values):
            number = getattr(mavlink, f"MAV_CMD_{name}")
            link.mav.command_long_send(1, 100, number, 0, *values, *[0] * (7 - len(values)))
            return link.recv_match(type="COMMAND_ACK", blocking=True, timeout=500).result

        assert link.recv_match(type="HEARTBEAT", blocking=True, timeout=500).type == mavlink.MAV_TYPE_CAMERA
        status = mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
        assert result_of("SET_MESSAGE_INTERVAL", status, 1) == mavlink.MAV_RESULT_ACCEPTED  # microsecond
        x, y, w, h = boxes[0]
        corners = x / 320, y / 240, (x + w) / 320, (y + h) / 240
        assert result_of("CAMERA_TRACK_RECTANGLE", *corners) == mavlink.MAV_RESULT_ACCEPTED
        for _ in pipeline:
            found = link.recv_match(type="CAMERA_TRACKING_IMAGE_STATUS", blocking=True, timeout=2)
            if found is not None and found.tracking_status == mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE:
                break
        assert (found.rec_top_x, found.rec_top_y) == pytest.approx(corners[:2], abs=0.1)
        assert result_of("CAMERA_STOP_TRACKING") == mavlink.MAV_RESULT_ACCEPTED
        pipeline.close()
        assert "no longer tracked" in camera.communicate(timeout=500)[0]


def test_zone_counter_counts_visits(run_with_pipeline):
    _, printed = run_with_pipeline("zone_counter.py", "ENDPOINT", "all=0,0 320,0 320,240 0,240", "none=0,0 3,0 3,3")
    entered, left, everywhere, nowhere = printed
    assert entered.endswith("the object entered all, 1 inside")
    assert left.endswith("the object left all, 0 inside")
    assert re.fullmatch(r"all: 1 visits, [0-2]\.\d s in all", everywhere)
    assert nowhere == "none: 0 visits, 0.0 s in all"


def test_collector_stores_tracks_if_another_pipeline_is_missing(run_with_pipeline, tmp_path):
    found, printed = run_with_pipeline(
        "asyncio_collector.py", tmp_path / "tracks.sqlite", "ENDPOINT", "tcp://127.0.0.1"
    )
    with closing(sqlite3.connect(tmp_path / "tracks.sqlite")) as database:
        stored = {frame: rest for frame, *rest in database.execute("SELECT frame, state, score FROM tracks")}
    assert max(stored) == 59
    assert stored == {frame: [found[frame].state, found[frame].score] for frame in stored}
    assert "got 'tcp://127.0.0.1'" in "".join(printed)


def test_cvat_function_tracks_a_shape_by_its_state(demo_video):
    function = runpy.run_path(str(EXAMPLES / "cvat_function" / "main.py"))
    context = SimpleNamespace(user_data=SimpleNamespace(), Response=lambda **fields: SimpleNamespace(**fields))
    function["init_context"](context)
    source, boxes = demo_video(60)
    with open_source(source) as frames:
        pictures = [base64.b64encode(cv2.imencode(".png", frame.image)[1]).decode() for frame in frames]
    x, y, w, h = boxes[0]
    shapes, states = [[x, y, x + w, y + h]], []
    for frame in range(32):
        if frame == 30:
            context.user_data.trackers.clear()  # the function was started again
        body = {"image": pictures[frame], "shapes": shapes, "states": states}
        answer = function["handler"](context, SimpleNamespace(body=body))
        assert answer.status_code == 200
        shapes, states = [None], json.loads(answer.body)["states"]
    left, top, right, bottom = json.loads(answer.body)["shapes"][0]
    assert Box(left, top, right - left, bottom - top).overlap(boxes[31]) > 0.6
