"""Kernels: compiled once, and kept."""

import os
import subprocess
import sys
from pathlib import Path

from catstream.detection import compiled


def test_a_second_start_needs_no_compiler(tmp_path):
    script = "from catstream.detection import hog; print(sum(hog._count.stats.cache_hits.values()))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    hits = [
        int(subprocess.run([sys.executable, "-c", script], env=environment, check=True, capture_output=True).stdout)
        for _ in range(2)
    ]
    assert hits == [0, 1]


def test_kernels_are_cached_elsewhere_where_the_package_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _: str(path).startswith(str(tmp_path)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert Path(compiled._cache_folder()) == tmp_path / "catstream"
