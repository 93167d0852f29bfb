"""Kernels: compiled once, and kept."""

import os
import subprocess
import sys
from pathlib import Path

from catstream.features import COMPILING, compiled


def test_a_first_start_reports_that_it_compiles_and_a_second_needs_no_compiler(tmp_path):
    script = "from catstream.features import hog; print(sum(hog._count.stats.cache_hits.values()))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    starts = [
        subprocess.run([sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True)
        for _ in range(2)
    ]
    assert [int(start.stdout) for start in starts] == [0, 1]
    assert [start.stderr.splitlines() for start in starts] == [[COMPILING], []]


def test_kernels_are_cached_in_another_folder_if_the_package_is_read_only(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _: str(path).startswith(str(tmp_path)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert Path(compiled._cache_folder()) == tmp_path / "catstream"
