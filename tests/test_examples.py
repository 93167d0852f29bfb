"""Each example runs beside a real pipeline, and prints what that found."""

from __future__ import annotations

import contextlib
import re
import select
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import catstream
from catstream.errors import SilenceError
from catstream.pipeline import Pipeline
from catstream.settings import Settings
from catstream.wire.keys import create

EXAMPLES = Path(__file__).parents[1] / "examples"
MODULES = [EXAMPLES / "node_modules" / name for name in ("zeromq", "@msgpack/msgpack")]


def command(example):
    """How it is started; skips the test where this machine has not what it takes."""
    if example.endswith(".py"):
        return [sys.executable, EXAMPLES / example]
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no Node.js on this machine")
    if not all(module.exists() for module in MODULES):
        pytest.skip("its modules are missing: npm ci --prefix examples")
    return [node, EXAMPLES / example]


def test_the_rerun_subscriber_writes_what_the_viewer_would_show(demo_video, tmp_path):
    pytest.importorskip("rerun", reason='rerun is missing: pip install "catstream[rerun]"')
    (source, boxes), shown = demo_video(60), tmp_path / "walk.rrd"
    with (
        Pipeline(str(source), boxes[0], Settings(window=1)) as pipeline,
        subprocess.Popen(
            [sys.executable, EXAMPLES / "rerun_subscriber.py", pipeline.endpoint, "--save", shown],
            stdout=subprocess.PIPE,
            text=True,
        ) as reader,
    ):
        for _ in pipeline:
            if reader.poll() is None and not (shown.exists() and shown.stat().st_size > 20_000):
                select.select([reader.stdout], [], [], 0.5)  # while it starts, few pass
        printed = reader.communicate(timeout=60)[0]
    assert reader.returncode == 0
    losses = r"(0 missed|(\d+) missed, \2 of them before this began to listen)"
    assert re.fullmatch(rf"[1-9]\d* tracks, {losses}: the source came to its end\n", printed)
    data = shown.read_bytes()
    assert data.startswith(b"RRF2")
    for entity in (b"/camera/object", b"/score", b"/model", b"/state", b"Boxes2D"):
        assert entity in data, "it was logged"


@pytest.mark.parametrize("example", ["subscriber.py", "subscriber.mjs"])
@pytest.mark.parametrize("secured", [False, True], ids=["without keys", "with keys"])
def test_a_subscriber_prints_the_tracks_and_the_models_until_the_end(demo_video, example, secured, tmp_path):
    words, (source, boxes) = command(example), demo_video(60)
    keys = str(tmp_path / "keys") if secured else ""
    if secured:
        create(tmp_path / "keys")
    found, norms = {}, {}
    with (
        # A window of one: the pipeline goes on only as its tracks are taken.
        Pipeline(str(source), boxes[0], Settings(window=1, keys=keys)) as pipeline,
        catstream.subscribe(pipeline.endpoint, "models", timeout=0, keys=keys) as models,
        subprocess.Popen(
            [*words, pipeline.endpoint, *([keys] if secured else [])], stdout=subprocess.PIPE, text=True
        ) as reader,
    ):
        for track in pipeline:
            found[track.frame] = track
            with contextlib.suppress(SilenceError):
                model = next(models)
                norms[model.version] = np.linalg.norm(model.weights)
            select.select([reader.stdout], [], [], 0.3)  # while it starts, few pass
        printed = reader.communicate(timeout=60)[0].splitlines()
    assert reader.returncode == 0
    assert printed[-1] == "end: the source came to its end, 0 tracks missed"
    tracks = [text.split() for text in printed if text.startswith("track ")]
    assert [int(frame) for _, frame, *_ in tracks] == list(range(60 - len(tracks), 60))
    for _, frame, state, box, score in tracks:
        track = found[int(frame)]
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
