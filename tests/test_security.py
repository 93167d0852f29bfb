"""Nothing in the source runs what it reads: no pickle, no eval, no shell, no YAML loader."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = [
    path for folder in ("catstream", "services", "benchmarks", "examples") for path in ROOT.glob(f"{folder}/**/*.py")
]

#: Libraries whose files or bytes can hold a program, and calls that run a text.
PROGRAMS = {"cloudpickle", "dill", "joblib", "jsonpickle", "marshal", "pickle", "shelve", "yaml"}
RUNNERS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "subprocess.getoutput"}


def executed(path: Path) -> Iterator[str]:
    """The imports and calls of a program that could execute what it reads."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            yield from (name for name in names if name.partition(".")[0] in PROGRAMS)
        elif isinstance(node, ast.Call):
            yield from {ast.unparse(node.func)} & RUNNERS
            for keyword in node.keywords:
                if keyword.arg in ("shell", "allow_pickle") and ast.unparse(keyword.value) != "False":
                    yield keyword.arg


def test_no_input_is_executed():
    found = {str(path.relative_to(ROOT)): [*executed(path)] for path in FILES}
    assert not {place: calls for place, calls in found.items() if calls}
