"""Figures say what made them, and nothing of where that was."""

import json
import platform
import subprocess

from catstream.applications.evaluation import runs as module
from catstream.applications.evaluation.runs import machine, provenance
from catstream.settings import Settings


def test_neither_command_nor_machine_tell_folders_or_the_host_name():
    made = provenance(Settings(coreset={"size": 32}), ["catstream", "/home/me/walk", "--data=/home/me/walk"])
    assert (made["command"], made["settings"]) == ("catstream walk --data=walk", ["coreset.size=32"])
    told = machine()
    assert {"processor", "cores", "memory_gb", "python", "opencv", "blas", "numpy"} <= told.keys()
    assert platform.node() not in json.dumps(told)
    assert (module._ROOT / "pyproject.toml").is_file(), "the commit is that of this checkout"


def test_the_commit_is_that_of_the_checkout_and_dirty_if_the_code_was_changed(tmp_path, monkeypatch):
    def git(*words):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True)

    monkeypatch.setattr(module, "_ROOT", tmp_path)
    assert provenance(Settings())["commit"] is None
    for folder in ("catstream", "benchmarks/results"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "catstream" / "code.py").touch()
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = provenance(Settings())["commit"]
    (tmp_path / "benchmarks" / "results" / "speed.json").touch()
    assert provenance(Settings())["commit"] == commit
    (tmp_path / "catstream" / "code.py").write_text("changed")
    assert provenance(Settings())["commit"] == f"{commit}-dirty"
