"""Each example runs beside a real pipeline, and prints what that found."""

import re
import runpy
import select
import shutil
import subprocess
import sys
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

import catstream
from catstream.errors import SilenceError
from catstream.messages.kinds import Track
from catstream.pipeline import Pipeline
from catstream.video.source import open_source
from catstream.wire.keys import create

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).parents[1] / "examples"
MODULES = [EXAMPLES / "node_modules" / name for name in ("zeromq", "@msgpack/msgpack")]


def missing(example):
    """What this machine has not that the example takes; None if it has all."""
    if example.startswith("rerun"):
        return None if find_spec("rerun") else 'rerun is missing: pip install "catstream[rerun]"'
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


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """What the example for Rerun saves."""
    return tmp_path_factory.mktemp("shown") / "walk.rrd"


@pytest.fixture(scope="module", params=[False, True], ids=["without keys", "with keys"])
def beside(request, demo_video, shown, tmp_path_factory):
    """One run without keys and one with them, each with all examples that this machine can start and that take part."""
    source, boxes = demo_video(60)
    keys = str(tmp_path_factory.mktemp("keys") / "keys") if request.param else ""
    if keys:
        create(Path(keys))
    words = {name: [] for name in ("subscriber.py", "subscriber.mjs") if missing(name) is None}
    if not keys and missing("rerun_subscriber.py") is None:
        words["rerun_subscriber.py"] = ["--save", shown]
    with ExitStack() as stack:
        settings = {"run.unstored_frames": 1, "run.keys": keys}  # it continues only if its tracks are received
        pipeline = stack.enter_context(Pipeline(str(source), boxes[0], settings))
        models = stack.enter_context(catstream.subscribe(pipeline.endpoint, "models", timeout=0, keys=keys))
        readers = {}
        for name, more in words.items():
            start = [*command(name), pipeline.endpoint, *([keys] if keys else []), *more]
            readers[name] = stack.enter_context(subprocess.Popen(start, stdout=subprocess.PIPE, text=True))
        found, norms = {}, {}
        for track in pipeline:
            found[track.frame] = track
            with suppress(SilenceError):
                model = next(models)
                norms[model.version] = float(np.linalg.norm(model.weights))
            for name, reader in readers.items():
                if reader.poll() is None and not (name.startswith("rerun") and holds_tracks(shown)):
                    select.select([reader.stdout], [], [], 0.3)  # while they start, few pass
        told = {name: reader.communicate(timeout=60)[0] for name, reader in readers.items()}
    return Beside(found, norms, {name: (reader.returncode, told[name]) for name, reader in readers.items()})


def holds_tracks(shown):
    """Whether there is more than the beginning in the file that is shown."""
    return shown.exists() and shown.stat().st_size > 20_000


@pytest.mark.parametrize("beside", [False], ids=["without keys"], indirect=True)
def test_the_rerun_subscriber_writes_a_file_for_the_viewer(beside, shown):
    if why := missing("rerun_subscriber.py"):
        pytest.skip(why)
    code, printed = beside.printed["rerun_subscriber.py"]
    assert code == 0
    losses = r"(0 missed|(\d+) missed, \2 of them before this subscriber connected)"
    assert re.fullmatch(rf"[1-9]\d* tracks, {losses}: the source has ended\n", printed)
    data = shown.read_bytes()
    assert data.startswith(b"RRF2")
    for entity in (b"/camera/object", b"/score", b"/model", b"/state", b"Boxes2D"):
        assert entity in data, "it was logged"


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


def test_the_images_that_represent_a_folder_keep_a_share_of_the_energy_within_the_bounds(demo_video, tmp_path):
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
    run = subprocess.run([*command("summarise_images.py"), tmp_path, "4"], capture_output=True, text=True, timeout=60)
    assert run.stdout.count(".png") == 4, run.stderr
    assert "of the energy of all images is kept" in run.stdout


def test_tracks_become_detections_of_supervision():
    pytest.importorskip("supervision")
    detections = runpy.run_path(str(EXAMPLES / "to_supervision.py"))["detections"]
    track = Track(1, 0, 0.0, "present", catstream.Box(1, 2, 3, 4), 1.5, 0, object="anna")
    found = detections([track, Track(1, 0, 0.0, "absent", None, 0.1, 0, object="ben")])
    np.testing.assert_array_equal(found.xyxy, [[1, 2, 4, 6]])
    assert found.confidence.tolist() == [1.0]
    assert len(detections([])) == 0
