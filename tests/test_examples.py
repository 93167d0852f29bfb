"""Each example runs beside a real pipeline, and prints what that found."""

import base64
import json
import re
import runpy
import select
import shutil
import sqlite3
import subprocess
import sys
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import catstream
from catstream.base.box import Box
from catstream.errors import SilenceError
from catstream.messages.kinds import Track
from catstream.pipeline import Pipeline
from catstream.video.source import open_source
from catstream.wire.keys import create

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).parents[1] / "examples"
DOOR = ((50, 0), (90, 0), (90, 90), (50, 90))
MODULES = [EXAMPLES / "node_modules" / name for name in ("zeromq", "@msgpack/msgpack")]


def missing(example):
    """What this machine has not that the example takes; None if it has all."""
    if example.endswith(".py"):
        return None
    if shutil.which("node") is None:
        return "there is no Node.js on this machine"
    if not all(module.exists() for module in MODULES):
        return "its modules are missing: npm ci --prefix examples"
    return None


def command(example):
    """How it is started."""
    return [sys.executable if example.endswith(".py") else "node", EXAMPLES / example]


@dataclass
class Beside:
    """A run to its end, and what the examples beside it printed: name -> exit code, text.

    tracks  frame -> track
    norms   version -> norm of the weights, of the models that were heard
    """

    tracks: dict[int, Track]
    norms: dict[int, float]
    printed: dict[str, tuple[int, str]]


@pytest.fixture(scope="module", params=[False, True], ids=["without keys", "with keys"])
def beside(request, demo_video, tmp_path_factory):
    """One run without keys and one with them, each with all examples that this machine can start and that take part."""
    source, boxes = demo_video(60)
    keys = str(tmp_path_factory.mktemp("keys") / "keys") if request.param else ""
    if keys:
        create(Path(keys))
    names = [name for name in ("subscriber.py", "subscriber.mjs") if missing(name) is None]
    with ExitStack() as stack:
        settings = {"run.unstored_frames": 1, "run.keys": keys}  # it continues only if its tracks are received
        pipeline = stack.enter_context(Pipeline(str(source), boxes[0], settings))
        models = stack.enter_context(catstream.subscribe(pipeline.endpoint, "models", timeout=0, keys=keys))
        readers = {}
        for name in names:
            start = [*command(name), pipeline.endpoint, *([keys] if keys else [])]
            readers[name] = stack.enter_context(subprocess.Popen(start, stdout=subprocess.PIPE, text=True))
        found, norms = {}, {}
        for track in pipeline:
            found[track.frame] = track
            with suppress(SilenceError):
                model = next(models)
                norms[model.version] = float(np.linalg.norm(model.weights))
            for reader in readers.values():
                if reader.poll() is None:
                    select.select([reader.stdout], [], [], 0.3)  # while they start, few pass
        told = {name: reader.communicate(timeout=150)[0] for name, reader in readers.items()}
    return Beside(found, norms, {name: (reader.returncode, told[name]) for name, reader in readers.items()})


@pytest.mark.parametrize("example", ["subscriber.py", "subscriber.mjs"])
def test_a_subscriber_prints_the_tracks_and_the_models_until_the_end(beside, example):
    if why := missing(example):
        pytest.skip(why)
    code, text = beside.printed[example]
    printed, norms = text.splitlines(), beside.norms
    assert code == 0
    assert printed[-1] == "end: the source has ended, 0 tracks missed"
    tracks = [text.split() for text in printed if text.startswith("track ")]
    assert [int(frame) for _, frame, *_ in tracks] == list(range(60 - len(tracks), 60))
    for _, frame, state, box, score in tracks:
        track = beside.tracks[int(frame)]
        assert state == track.state
        assert float(score) == pytest.approx(track.score, abs=0.001)
        sides = None if box == "-" else [float(side) for side in box.split(",")]
        assert sides == (track.box and pytest.approx(track.box, abs=0.1))
    learned = re.findall(r"^model (\d+) of frame \d+, norm (.*)$", "\n".join(printed), re.MULTILINE)
    versions = [int(version) for version, _ in learned]
    assert versions == sorted(set(versions))
    seen = {int(version): float(norm) for version, norm in learned if int(version) in norms}
    assert seen
    assert seen == pytest.approx({version: norms[version] for version in seen}, abs=0.0001)


def test_the_example_of_several_objects_prints_when_two_meet_and_part(demo_video):
    source, boxes = demo_video(60)
    sky = catstream.Box(boxes[0].x, boxes[0].y - 30, boxes[0].w, 40)  # the lower part of it is on the flower
    arguments = [str(source), f"flower={boxes[0]}", f"sky={sky}"]
    run = subprocess.run([*command("several_objects.py"), *arguments], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    *events, flower, sky = run.stdout.splitlines()
    turns = [re.fullmatch(r"frame \d+: flower and sky (meet|part)", line)[1] for line in events]
    assert events[0] == "frame 0: flower and sky meet"
    assert turns == ["meet", "part"] * (len(turns) // 2) + ["meet"] * (len(turns) % 2)
    assert flower == "flower: present in 60 of 60 frames"
    assert re.fullmatch(r"sky: present in \d+ of 60 frames", sky)


def test_the_images_that_represent_a_folder_keep_the_energy_within_the_bounds(demo_video, tmp_path):
    example = runpy.run_path(str(EXAMPLES / "summarise_images.py"))
    summary, rows = example["Summary"](size=8), {}
    with open_source(demo_video(60)[0]) as frames:
        for frame in frames:
            cv2.imwrite(str(tmp_path / f"{frame.number:02d}.png"), frame.image)
            summary.add(f"{frame.number:02d}.png", frame.image)
            rows[f"{frame.number:02d}.png"] = example["describe"](frame.image).astype(float)
    shares, kept, kept_at_most = summary.result(4)
    assert len(summary.rows) < 16
    basis = np.linalg.qr(np.array([rows[name] for name in shares]).T)[0]
    whole = np.array([*rows.values()])
    assert kept <= np.sum((whole @ basis) ** 2) / np.sum(whole**2) <= kept_at_most
    run = subprocess.run([*command("summarise_images.py"), tmp_path, "4"], capture_output=True, text=True, timeout=150)
    assert run.stdout.count(".png") == 4, run.stderr
    assert "of the energy of all images is kept" in run.stdout


def test_tracks_become_detections_of_supervision():
    pytest.importorskip("supervision")
    detections = runpy.run_path(str(EXAMPLES / "to_supervision.py"))["detections"]
    track = Track(0, 0.0, "present", catstream.Box(1, 2, 3, 4), 1.5, 0, object="anna")
    found = detections([track, Track(0, 0.0, "absent", None, 0.1, 0, object="ben")])
    np.testing.assert_array_equal(found.xyxy, [[1, 2, 4, 6]])
    assert found.confidence.tolist() == [1.0]
    assert len(detections([])) == 0


def test_a_ground_station_finds_the_camera_selects_an_object_and_is_told_where_it_is(demo_video, monkeypatch):
    pytest.importorskip("pymavlink", reason="pymavlink is missing: pip install pymavlink")
    monkeypatch.setenv("MAVLINK20", "1")
    mavlink, mavutil = import_module("pymavlink.dialects.v20.common"), import_module("pymavlink.mavutil")
    source, boxes = demo_video(60)
    with ExitStack() as stack:
        link = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255, dialect="common")
        stack.callback(link.close)
        pipeline = stack.enter_context(Pipeline(str(source), settings={"run.unstored_frames": 1}))
        words = [pipeline.endpoint, "--link", f"udpout:127.0.0.1:{link.port.getsockname()[1]}"]
        camera = stack.enter_context(subprocess.Popen([*command("mavlink_gimbal.py"), *words], stdout=subprocess.PIPE))
        stack.callback(camera.kill)

        told = {}  # kind -> the last message before an answer

        def result_of(name, *values):
            number = getattr(mavlink, f"MAV_CMD_{name}")
            link.mav.command_long_send(1, 100, number, 0, *values, *[0] * (7 - len(values)))
            while (message := link.recv_match(blocking=True, timeout=150)).get_type() != "COMMAND_ACK":
                told[message.get_type()] = message
            assert message.command == number
            return message.result

        heartbeat = link.recv_match(type="HEARTBEAT", blocking=True, timeout=150)
        assert (heartbeat.type, heartbeat.get_srcComponent()) == (mavlink.MAV_TYPE_CAMERA, 100)
        assert result_of("REQUEST_MESSAGE", mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION) == mavlink.MAV_RESULT_ACCEPTED
        camera_information = told["CAMERA_INFORMATION"]
        assert (camera_information.resolution_h, camera_information.resolution_v) == (320, 240)
        assert camera_information.flags == mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
        status = mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
        assert result_of("SET_MESSAGE_INTERVAL", status, 1) == mavlink.MAV_RESULT_ACCEPTED  # microsecond
        assert result_of("CAMERA_TRACK_POINT", 0.5, 0.5) == mavlink.MAV_RESULT_UNSUPPORTED
        assert result_of("CAMERA_TRACK_RECTANGLE", 2, 2, 3, 3) == mavlink.MAV_RESULT_DENIED
        x, y, w, h = boxes[0]
        corners = x / 320, y / 240, (x + w) / 320, (y + h) / 240
        assert result_of("CAMERA_TRACK_RECTANGLE", *corners) == mavlink.MAV_RESULT_ACCEPTED
        expected, statuses, ahead = [], [], 0
        for track in pipeline:
            if track.box is not None:
                x, y, w, h = track.box
                expected.append(pytest.approx([x / 320, y / 240, (x + w) / 320, (y + h) / 240], abs=1e-6))
            if len(statuses) == 5:
                ahead += 1  # a status may have arrived before its track was read here
            elif each := link.recv_match(type="CAMERA_TRACKING_IMAGE_STATUS", blocking=True, timeout=0.1):
                statuses.append(each)
            if ahead == 10:
                break
        assert len(statuses) == 5
        for each in statuses:
            assert each.tracking_status == mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
            assert [each.rec_top_x, each.rec_top_y, each.rec_bottom_x, each.rec_bottom_y] in expected
        assert result_of("CAMERA_STOP_TRACKING") == mavlink.MAV_RESULT_ACCEPTED
        assert told["CAMERA_TRACKING_IMAGE_STATUS"].tracking_status == 0
        pipeline.close()
        assert camera.wait(150) == 0
        *_, begun, forgotten = camera.stdout.read().decode().splitlines()
        assert "begins" in begun
        assert "no longer tracked" in forgotten


def test_the_zone_counter_counts_the_visits_of_an_object_and_their_time(capsys):
    example = runpy.run_path(str(EXAMPLES / "zone_counter.py"))
    events, counter = example["Events"](example["SinkOptions"](zones={"door": DOOR})), example["Counter"]()
    for frame, x in enumerate([0, 60, 70, 0, 60, 0]):
        track = Track(frame, frame / 2, "present", catstream.Box(x, 40, 20, 20), 0.9, 1, object="anna")
        for event in events.update([track]):
            counter.take(event)
    assert dict(counter.visits)["door"] == [1.0, 0.5]
    assert capsys.readouterr().out.splitlines()[:2] == [
        "0.5 s: anna entered door, 1 inside",
        "1.5 s: anna left door, 0 inside",
    ]


def test_the_zone_counter_counts_beside_a_run(demo_video):
    source, boxes = demo_video(60)
    with ExitStack() as stack:
        pipeline = stack.enter_context(Pipeline(str(source), boxes[0], {"run.unstored_frames": 1}))
        words = [*command("zone_counter.py"), pipeline.endpoint, "all=0,0 320,0 320,240 0,240", "none=0,0 3,0 3,3"]
        counter = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        stack.callback(counter.kill)
        counts = []
        for _ in pipeline:
            counts = counts or select.select([counter.stdout], [], [], 0.3)[0]  # while it starts, few pass
        printed, _ = counter.communicate(timeout=150)
    assert counter.returncode == 0
    entered, left, everywhere, nowhere = printed.splitlines()
    assert entered.endswith("the object entered all, 1 inside")
    assert left.endswith("the object left all, 0 inside")
    assert re.fullmatch(r"all: 1 visits, [0-2]\.\d s in all", everywhere)
    assert nowhere == "none: 0 visits, 0.0 s in all"


def test_the_collector_stores_the_tracks_of_two_pipelines_although_one_is_missing(demo_video, tmp_path):
    source, boxes = demo_video(60)
    with ExitStack() as stack:
        settings = {"run.unstored_frames": 1}
        runs = [stack.enter_context(Pipeline(str(source), boxes[0], settings)) for _ in range(2)]
        words = [tmp_path / "tracks.sqlite", *(run.endpoint for run in runs), "tcp://127.0.0.1"]
        collector = stack.enter_context(
            subprocess.Popen([*command("asyncio_collector.py"), *words], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(collector.kill)
        assert "got 'tcp://127.0.0.1'" in collector.stdout.readline()  # it has subscribed to the others before
        found = [list(run) for run in runs]
        printed, _ = collector.communicate(timeout=150)
    assert collector.returncode == 0
    with closing(sqlite3.connect(tmp_path / "tracks.sqlite")) as database:
        for run, tracks in zip(runs, found, strict=True):
            rows = database.execute("SELECT frame, state, x, score FROM tracks WHERE pipeline = ?", [run.endpoint])
            expected = {track.frame: (track.state, track.box and track.box.x, track.score) for track in tracks}
            stored = {frame: tuple(rest) for frame, *rest in rows}
            assert stored == {frame: expected[frame] for frame in stored}
            assert f"{run.endpoint}: {len(stored)} tracks, " in printed
            assert max(stored) == 59


def test_the_cvat_function_tracks_shapes_by_their_states_and_restarts_lost_trackers(demo_video):
    function = runpy.run_path(str(EXAMPLES / "cvat_function" / "main.py"))
    context = SimpleNamespace(user_data=SimpleNamespace(), Response=lambda **fields: SimpleNamespace(**fields))
    function["init_context"](context)
    source, boxes = demo_video(60)
    with open_source(source) as frames:
        pictures = [base64.b64encode(cv2.imencode(".png", frame.image)[1]).decode() for frame in frames]
    truth = [[box.x, box.y, box.x + box.w, box.y + box.h] for box in boxes]

    def box_of(shape):
        left, top, right, bottom = shape
        return Box(left, top, right - left, bottom - top)

    def asked(frame, shapes, states):
        body = {"image": pictures[frame], "shapes": shapes, "states": json.loads(json.dumps(states))}
        answer = function["handler"](context, SimpleNamespace(body=body))
        return answer.status_code, answer.body

    def followed(frame, states):
        code, body = asked(frame, [None] * len(states), states)
        assert code == 200
        return json.loads(body)

    code, body = asked(0, [truth[0], [10, 10, 50, 50]], [])
    answer = first = json.loads(body)
    assert (code, answer["shapes"][0]) == (200, truth[0])
    for frame in range(1, 30):
        answer = followed(frame, answer["states"])
        assert box_of(answer["shapes"][0]).overlap(boxes[frame]) > 0.6
    again = followed(1, first["states"])  # the annotator went back: those trackers are in another frame
    assert again["shapes"] == first["shapes"]
    context.user_data.trackers.clear()  # the function was started again
    answer = followed(30, answer["states"])
    assert box_of(followed(31, answer["states"])["shapes"][0]).overlap(boxes[31]) > 0.6
    assert asked(0, [[5, 5, 5, 5]], [])[0] == 400
    pictures[0] = base64.b64encode(b"no picture").decode()
    assert asked(0, truth[:1], []) == (400, "expected a picture as PNG or JPEG, in base64")
