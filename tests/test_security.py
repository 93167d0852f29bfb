"""Nothing in the source runs what it reads: no pickle, no eval, no shell, no YAML loader."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted(
    path for folder in ("catstream", "services", "benchmarks", "examples") for path in ROOT.glob(f"{folder}/**/*.py")
)

#: Libraries whose files or bytes can hold a program.
PROGRAMS = {"cloudpickle", "dill", "joblib", "jsonpickle", "marshal", "pickle", "shelve", "yaml"}

#: Calls that run a text.
RUNNERS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "subprocess.getoutput"}

#: Arguments that turn it on.
SWITCHES = {"shell", "allow_pickle"}


def name_of(node: ast.expr) -> str:
    """Dotted name of what is called; empty for anything else."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def found(source: str) -> list[str]:
    """What of all this a program does."""
    wrong = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            wrong += [alias.name for alias in node.names if alias.name.partition(".")[0] in PROGRAMS]
        elif isinstance(node, ast.ImportFrom):
            wrong += [node.module or ""] if (node.module or "").partition(".")[0] in PROGRAMS else []
        elif isinstance(node, ast.Call):
            wrong += [name_of(node.func)] if name_of(node.func) in RUNNERS else []
            for keyword in node.keywords:
                off = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
                wrong += [str(keyword.arg)] if keyword.arg in SWITCHES and not off else []
    return wrong


def test_no_input_is_executed():
    wrong = {str(path.relative_to(ROOT)): found(path.read_text(encoding="utf-8")) for path in FILES}
    assert not {place: calls for place, calls in wrong.items() if calls}


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from yaml import load",
        "import numpy as np\nnp.load('a.npy', allow_pickle=True)",
        "eval('1')",
        "import os\nos.system('true')",
        "import subprocess\nsubprocess.run('true', shell=True)",
        "import subprocess\nsubprocess.run('true', shell=bool(1))",
    ],
)
def test_each_forbidden_pattern_is_found(source):
    assert found(source)


HOLE = {"id": "CVE-1", "fix_versions": ["2.0"]}


@pytest.mark.parametrize(
    ("said", "code", "words"),
    [
        (json.dumps({"dependencies": [{"name": "a", "version": "1.0", "vulns": [HOLE]}]}), 1, "CVE-1, mended in 2.0"),
        (json.dumps({"dependencies": [{"name": "a", "version": "1.0", "vulns": []}]}), 0, "1 libraries audited"),
        (json.dumps({"dependencies": [{"name": "a", "skip_reason": "who?"}]}), 0, "0 libraries audited"),
        ("", 0, "not audited"),
    ],
    ids=["a hole", "none", "unknown", "no network"],
)
def test_an_audit_fails_for_a_hole_and_nothing_else(said, code, words, tmp_path):
    (tmp_path / "pip_audit.py").write_text(f"print({said!r})")
    audit = [sys.executable, ROOT / ".ci" / "audit"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    run = subprocess.run(audit, env=environment, capture_output=True, text=True, timeout=150)
    assert run.returncode == code
    assert words in run.stdout
