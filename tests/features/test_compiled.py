"""Kernels: compiled once, and kept."""

import os
import subprocess
import sys
from pathlib import Path

from catstream.features import COMPILING, compiled


def test_a_first_start_reports_that_it_compiles_and_a_second_imports_no_compiler(tmp_path):
    script = "import sys; from catstream.features import hog; print('numba' in sys.modules)"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    starts = [
        subprocess.run([sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True)
        for _ in range(2)
    ]
    assert [start.stdout.strip() for start in starts] == ["True", "False"]
    assert [start.stderr.splitlines() for start in starts] == [[COMPILING], []]


def test_kernels_are_cached_in_another_folder_if_the_package_is_read_only(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _: str(path).startswith(str(tmp_path)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compiled._cache_folder() == Path(tmp_path / "catstream")
