"""Every benchmark runs on a few rendered frames, and the parts of the benchmarks of accuracy are right."""

import json
import math
import platform
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.errors import BoxError, SettingsError
from catstream.measure.datasets import Sequence, find_sequences

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))

import opencv_trackers  # noqa: E402
import provenance  # noqa: E402
from accuracy import TrackerRun, is_lost, rows_of  # noqa: E402
from keyframes import KeyframeRow, boxes_until_complete, mean_by_boxes  # noqa: E402
from starts import SHIFTS, Start, jittered, one_pass, spatial, temporal  # noqa: E402

NO_BENCHMARKS = {BENCHMARKS / "page.py", BENCHMARKS / "provenance.py"}
SLOW = BENCHMARKS / "fleet" / "faults.py"  # minutes; tests/fleet/test_fleet.py kills a node, too
CASES = [
    pytest.param(path, id=str(path.relative_to(BENCHMARKS)), marks=[pytest.mark.slow] if path == SLOW else [])
    for path in sorted({path for path in BENCHMARKS.rglob("*.py") if "__main__" in path.read_text()} - NO_BENCHMARKS)
]


@pytest.mark.system
@pytest.mark.timeout(600)  # some start many processes, one after the other
@pytest.mark.parametrize("script", CASES)
def test_a_benchmark_runs_and_writes_finite_figures(script, tmp_path):
    figures = tmp_path / "figures.json"
    subprocess.run([sys.executable, script, "--quick", "--json", figures], cwd=tmp_path, check=True)
    tables = json.loads(figures.read_text())["tables"]
    assert tables
    for table in tables:
        assert table["rows"], table["title"]
        for row in table["rows"]:
            assert len(row) == len(table["columns"])
            assert all(math.isfinite(cell) for cell in row if isinstance(cell, float)), (table["title"], row)


@pytest.fixture
def sequence(walk) -> Sequence:
    return find_sequences(walk)[0]


def test_temporal_starts_are_evenly_spaced_frames_with_a_usable_box(sequence):
    def frames(count: int) -> list[int]:
        return [start.frame for start in temporal(count)(sequence)]

    assert (frames(1), frames(2), frames(4)) == ([0], [0, 8], [0, 3, 8, 9])  # the object is absent in 5, 6 and 7
    boxes = sequence.boxes.copy()
    boxes[[0, 3]] = (-99, 0, 330, 90)
    sequence = replace(sequence, boxes=boxes)
    assert frames(4) == [1, 4, 8, 9]


def test_spatial_starts_are_those_of_cvpr2013_and_jitter_is_within_two_percent(sequence):
    x, y, w, h = sequence.boxes[0]
    boxes = np.array([start.box(sequence) for start in spatial(sequence)])
    np.testing.assert_allclose(boxes[8:, 2:], np.outer([0.8, 0.9, 1.1, 1.2], (w, h)))
    centres = boxes[:, :2] + boxes[:, 2:] / 2 - (x + w / 2, y + h / 2)
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1), *[(0, 0)] * 4]
    np.testing.assert_allclose(centres, np.array(moves) * (0.1 * w, 0.1 * h), atol=1e-9)
    first, *others = (start.box(sequence) for start in jittered(7)(sequence))
    assert first == Box(x, y, w, h)
    for box in others:
        assert max(abs(np.subtract(box, first) / (w, h, w, h))) <= 0.03
    late = replace(sequence, boxes=np.vstack([np.full((3, 4), np.nan), sequence.boxes]))
    assert {start.suffix for start in spatial(late)} > {"@3-left", "@3-size-0.8"}


@pytest.mark.parametrize("variation", SHIFTS, ids=lambda variation: variation.name)
def test_tracking_can_start_with_a_changed_box_at_the_border(sequence, variation):
    border = replace(sequence, boxes=sequence.boxes - sequence.boxes[0] + (-29, 40, 60, 60))
    box = Start(0, variation).box(border)
    assert box.validated(*border.size()) is box


def test_rows_have_means_and_spreads_of_the_runs_and_flip_if_the_first_box_decides(sequence):
    def run(kept: int, start: Start) -> TrackerRun:
        boxes = np.where(np.arange(12)[:, None] < kept, sequence.boxes, np.nan)
        return TrackerRun(sequence, boxes, np.full(12, 0.02), "catstream", start)

    starts = jittered(2)(sequence)
    (flipping,), (steady,), (plain,) = (rows_of(map(run, kept, starts)) for kept in ((12, 9), (12, 10), (12,)))
    assert (flipping.flips, steady.flips, plain.flips) == (True, False, None)  # 0.33 and 0.22 of nine frames are lost
    assert (flipping.runs, flipping.absent, flipping.present, flipping.false) == (2, 6, 18, 3)
    assert flipping.success == pytest.approx((1 + 6 / 9) / 2)
    assert flipping.success_spread == pytest.approx((1 - 6 / 9) / 2)
    assert plain.fps == pytest.approx(50)
    assert one_pass(sequence) == starts[:1]


@pytest.mark.parametrize(
    ("followed", "lost"),
    [
        ([True] * 6 + [True, False], False),  # half of the last quarter
        ([True] * 3 + [False] * 2, True),  # the last quarter of five frames is two
        ([True] * 12 + [False, None, None, None], True),  # frames without the object do not count
        ([True] * 12 + [None, None, None, None], False),
    ],
)
def test_a_run_is_lost_if_less_than_half_of_its_last_quarter_is_followed(followed, lost):
    truth = np.tile([10.0, 10, 20, 20], (len(followed), 1))
    boxes = np.where(np.array(followed, bool)[:, None], truth, truth + 15)
    truth[[each is None for each in followed]] = np.nan
    assert is_lost(boxes, truth) == lost


def test_keyframes_are_averaged_where_there_is_a_measure_and_complete_from_the_first_number():
    def row(name, boxes, complete, precision=None):
        return KeyframeRow(name, boxes, 1.0, 1.0, precision, 1.0, complete, 0.0, 0.0)

    rows = [row("a", 1, 0.0), row("a", 2, 1.0, 0.5), row("a", 3, 1.0), row("b", 1, 0.0, 0.5)]
    assert boxes_until_complete(rows) == {"a": 2, "b": None}
    assert [mean.precision for mean in mean_by_boxes(rows)] == [0.5, 0.5, None]


def test_a_box_at_the_border_is_clipped_for_opencv_and_errors_are_named(sequence, monkeypatch, tmp_path):
    frame, peer = next(sequence.frames()), opencv_trackers.Peer("mil")
    peer.init(frame, (-8.0, 90.0, 40.0, 40.0))
    assert peer.update(frame)[0]
    with pytest.raises(BoxError, match="outside the frame of 160 x 120"):
        peer.init(frame, (-90, 0, 60, 60))
    with pytest.raises(SettingsError, match=r"missing model file of .*: add object_tracking_vittrack"):
        opencv_trackers.Peer("vit", tmp_path)
    monkeypatch.setitem(opencv_trackers.PEERS, "csrt", "TrackerThatIsNot")
    with pytest.raises(SettingsError, match=r"catstream\[peers\]"):
        opencv_trackers.Peer("csrt")


class Brightness:
    """A network for `NanoTrackV3`: the features are the picture, and the object is where it is brightest, 30 x 30."""

    def __init__(self, *_):
        self.inputs = {}

    def setInput(self, blob, name=""):
        self.inputs[name] = blob

    def forward(self, outputs=None):
        if outputs is None:
            return self.inputs[""]
        places = 127 + 16 * np.arange(-7, 8)
        light = cv2.blur(self.inputs["input2"][0].mean(axis=0), (61, 61))[np.ix_(places, places)]
        return np.stack([0 * light, light / 2 - 120])[None], np.full((1, 4, 15, 15), 30.0)


def test_nanotrack_moves_its_box_to_the_place_with_the_highest_score(monkeypatch):
    monkeypatch.setattr(cv2.dnn, "readNet", Brightness)
    tracker = opencv_trackers.NanoTrackV3(cv2.TrackerNano_Params())
    for step in range(6):
        frame = np.zeros((240, 320, 3), np.uint8)
        cv2.rectangle(frame, (100 + 10 * step, 80 + 10 * step), (139 + 10 * step, 119 + 10 * step), (255, 255, 255), -1)
        box = (100, 80, 40, 40)
        if step == 0:
            tracker.init(frame, box)
        else:
            _, box = tracker.update(frame)
        assert Box(*box).overlap(Box(100 + 10 * step, 80 + 10 * step, 40, 40)) > 0.6


def test_provenance_has_no_folder_and_the_commit_is_dirty_if_the_code_was_changed(tmp_path, monkeypatch):
    def git(*words):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True)

    def made():
        return provenance.provenance(["coreset.size=32"], ["catstream", "/home/me/walk", "--data=/home/me/walk"])

    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    assert (made()["command"], made()["commit"]) == ("catstream walk --data=walk", None)
    assert platform.node() not in json.dumps(made())
    for folder in ("catstream", "benchmarks/results"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "catstream" / "code.py").touch()
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = made()["commit"]
    (tmp_path / "benchmarks" / "results" / "speed.json").touch()
    assert made()["commit"] == commit
    (tmp_path / "catstream" / "code.py").write_text("changed")
    assert made()["commit"] == f"{commit}-dirty"
