"""Every benchmark runs on a few rendered frames, and the parts of the benchmarks of accuracy are right."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.measure.datasets import Sequence, find_sequences

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))

from accuracy import TrackerRun, is_lost, rows_of  # noqa: E402
from starts import Start, jittered, one_pass, spatial, temporal  # noqa: E402

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
