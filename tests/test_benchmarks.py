"""Every benchmark runs, on a few rendered frames: what it would measure is for a quiet machine."""

import json
import math
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
ALONE, PAGE = BENCHMARKS / "startup.py", BENCHMARKS / "page.py"
SLOW = BENCHMARKS / "fleet" / "faults.py"  # minutes; tests/fleet/test_fleet.py kills a node, too
#: Its cluster is detached: it runs on when the object is deleted that has started it.
SLOW_MARKS = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:subprocess:ResourceWarning")]
SCRIPTS = sorted({path for path in BENCHMARKS.rglob("*.py") if "__main__" in path.read_text()} - {ALONE, PAGE})
CASES = [
    pytest.param(path, id=str(path.relative_to(BENCHMARKS)), marks=SLOW_MARKS if path == SLOW else [])
    for path in SCRIPTS
]


@pytest.mark.system
@pytest.mark.timeout(600)  # some start many processes, one after the other
@pytest.mark.parametrize("script", CASES)
def test_a_benchmark_runs_and_writes_finite_figures(script, tmp_path, monkeypatch):
    figures = tmp_path / "figures.json"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), "--quick", "--json", str(figures)])
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])  # as Python has it for a script
    monkeypatch.delitem(sys.modules, "shared", raising=False)  # it adds the folder of the benchmarks to the path
    runpy.run_path(str(script), run_name="__main__")
    assert_finite(figures)


@pytest.mark.system
def test_a_benchmark_runs_as_a_process_of_its_own(tmp_path):
    figures = tmp_path / "figures.json"
    command = [sys.executable, ALONE, "--quick", "--json", figures]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=150, check=False)
    assert done.returncode == 0, done.stderr
    assert_finite(figures)


def assert_finite(figures):
    tables = json.loads(figures.read_text())["tables"]
    assert tables
    for table in tables:
        assert table["rows"], table["title"]
        for row in table["rows"]:
            assert len(row) == len(table["columns"])
            assert all(math.isfinite(cell) for cell in row if isinstance(cell, float)), (table["title"], row)
