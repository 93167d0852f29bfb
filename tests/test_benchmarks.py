"""Every benchmark runs, on a few rendered frames: what it would measure is for a quiet machine."""

import json
import math
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
ALONE, PAGE = BENCHMARKS / "kernels.py", BENCHMARKS / "page.py"
SLOW = BENCHMARKS / "fleet" / "faults.py"  # minutes; tests/fleet/test_fleet.py kills a node, too
#: Its cluster is detached: it runs on when the object is deleted that has started it.
SLOW_MARKS = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:subprocess:ResourceWarning")]
SCRIPTS = sorted({path for path in BENCHMARKS.rglob("*.py") if "__main__" in path.read_text()} - {ALONE, PAGE})
CASES = [
    pytest.param(path, id=str(path.relative_to(BENCHMARKS)), marks=SLOW_MARKS if path == SLOW else [])
    for path in SCRIPTS
]


@pytest.mark.system
@pytest.mark.parametrize("script", CASES)
def test_a_benchmark_runs_and_writes_finite_figures(script, tmp_path, monkeypatch):
    figures = tmp_path / "figures.json"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), "--quick", "--json", str(figures)])
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])  # as Python has it for a script
    runpy.run_path(str(script), run_name="__main__")
    assert_finite(figures)


@pytest.mark.system
def test_a_benchmark_runs_as_a_process_of_its_own(tmp_path):
    figures = tmp_path / "figures.json"
    command = [sys.executable, ALONE, "--quick", "--json", figures]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=150, check=False)
    assert done.returncode == 0, done.stderr
    assert_finite(figures)


def test_two_runs_part_in_the_first_of_five_frames_apart_and_else_where_they_overlap_least(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    parting = runpy.run_path(str(BENCHMARKS / "forks.py"))["parting"]
    boxes = np.tile([10.0, 10, 20, 20], (20, 1))
    others = boxes.copy()
    others[3:7, 0] += 40  # four frames are too few
    others[5, 0] = np.nan
    assert parting(boxes, others) == 3
    others[10:15, 0] += 40
    assert parting(boxes, others) == 10


def assert_finite(figures):
    tables = json.loads(figures.read_text())["tables"]
    assert tables
    for table in tables:
        assert table["rows"], table["title"]
        for row in table["rows"]:
            assert len(row) == len(table["columns"])
            assert all(math.isfinite(cell) for cell in row if isinstance(cell, float)), (table["title"], row)
