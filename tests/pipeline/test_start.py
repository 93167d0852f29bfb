"""With which interpreter processes are started, and where they look for modules."""

from __future__ import annotations

import os
import subprocess
import sys
from multiprocessing import spawn
from pathlib import Path

import pytest

import catstream
from catstream.errors import ServiceError
from catstream.services.start import environment, import_path, python_command

HOME = str(Path(catstream.__file__).parents[1])


def test_children_use_the_import_path_of_this_program_without_the_current_folder(tmp_path, monkeypatch):
    own = tmp_path / "own"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", ".", "own", str(tmp_path), str(own), HOME])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", ".", str(tmp_path), str(own)]))
    assert import_path() == [str(own), HOME]
    assert environment()["PYTHONPATH"] == str(own)


def test_the_folder_that_catstream_was_imported_from_stays_in_the_import_path(monkeypatch):
    monkeypatch.chdir(HOME)
    monkeypatch.setattr(sys, "path", [""])
    assert import_path() == [HOME]


def test_a_current_folder_that_was_removed_is_no_obstacle(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert HOME in import_path() or HOME not in sys.path


def test_children_import_the_catstream_of_their_parent(tmp_path, monkeypatch):
    (tmp_path / "catstream").mkdir()
    (tmp_path / "catstream" / "__init__.py").write_text("raise SystemExit('another catstream')")
    monkeypatch.chdir(tmp_path)
    command = python_command("import catstream; print(catstream.__file__)")
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == catstream.__file__, done.stderr


@pytest.mark.parametrize("executable", ["", "/usr/sbin/uwsgi"])
def test_a_program_that_embeds_python_is_not_used_as_the_interpreter(executable, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", executable)
    monkeypatch.setattr(spawn, "get_executable", lambda: executable)
    assert Path(python_command("")[0]).name.startswith("python")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with pytest.raises(ServiceError, match=r"multiprocessing.set_executable"):
        python_command("")
