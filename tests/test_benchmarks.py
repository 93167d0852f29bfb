"""Every benchmark runs on a few rendered frames; the starts and the losses of the robustness benchmark."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.measure.datasets import find_sequences

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))

from accuracy import is_lost  # noqa: E402
from starts import jittered, spatial  # noqa: E402

NO_BENCHMARKS = {BENCHMARKS / "page.py", BENCHMARKS / "provenance.py"}
SLOW = BENCHMARKS / "fleet" / "faults.py"  # minutes; tests/fleet/test_fleet.py kills a node, too
CASES = [
    pytest.param(path, id=str(path.relative_to(BENCHMARKS)), marks=[pytest.mark.slow] if path == SLOW else [])
    for path in sorted({path for path in BENCHMARKS.rglob("*.py") if "__main__" in path.read_text()} - NO_BENCHMARKS)
]


@pytest.mark.system
@pytest.mark.timeout(600)  # some start many processes, one after the other
@pytest.mark.parametrize("script", CASES)
def test_benchmark_runs_and_writes_finite_figures(script, tmp_path):
    figures = tmp_path / "figures.json"
    subprocess.run([sys.executable, script, "--quick", "--json", figures], cwd=tmp_path, check=True)
    tables = json.loads(figures.read_text())["tables"]
    assert tables
    for table in tables:
        assert table["rows"], table["title"]
        for row in table["rows"]:
            assert len(row) == len(table["columns"])
            assert all(math.isfinite(cell) for cell in row if isinstance(cell, float)), (table["title"], row)


def test_spatial_starts_are_those_of_cvpr2013(walk):
    (sequence,) = find_sequences(walk)
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


@pytest.mark.parametrize(
    ("followed", "lost"),
    [
        ([True] * 6 + [True, False], False),  # half of the last quarter
        ([True] * 3 + [False] * 2, True),  # the last quarter of five frames is two
        ([True] * 12 + [False, None, None, None], True),  # frames without the object do not count
        ([True] * 12 + [None, None, None, None], False),
    ],
)
def test_run_is_lost_if_it_misses_half_of_its_last_quarter(followed, lost):
    truth = np.tile([10.0, 10, 20, 20], (len(followed), 1))
    boxes = np.where(np.array(followed, bool)[:, None], truth, truth + 15)
    truth[[each is None for each in followed]] = np.nan
    assert is_lost(boxes, truth) == lost
