"""The rules of imports in `docs/architecture.md`: downward only, and each foreign library in one place."""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from catstream.errors import EXTRAS

ROOT = Path(__file__).parents[1]

#: From the lowest. A module imports only from lower levels than its own, and from its own folder.
LEVELS = [
    {"errors"},
    {"base"},
    {"numerics"},
    {"messages"},
    {"features"},
    {"paper"},
    {"detection", "compression", "training", "wire", "video"},
    {"jobs"},
    {"multi", "client", "sketch"},
    {"sinks"},
    {"tracker", "processes"},
    {"pipeline", "annotation"},
    {"reports", "web"},
    {"evaluation", "batch"},
    {"finding", "loadtest", "fleet"},
    {"cli"},
]

#: The files or folders that may import a foreign library.
IMPORTERS = {
    "numpy": ["catstream"],
    "scipy": [
        *("catstream/numerics/ridge.py", "catstream/compression/reduce.py"),
        "catstream/base/threads.py",  # its BLAS is limited, too
    ],
    "cv2": [
        "catstream/features",
        "catstream/detection",
        "catstream/paper",
        "catstream/video",
        "catstream/base/threads.py",
        *("catstream/evaluation/peers.py", "catstream/evaluation/nanotrack.py"),
        "catstream/reports/provenance.py",  # its version
        "catstream/processes/detector.py",
        "catstream/sinks/events.py",
    ],
    "filterpy": ["catstream/training/motion_em.py"],
    "numba": ["catstream/features/kernels.py"],
    "sklearn": [
        *("catstream/paper/scm.py", "catstream/paper/one_class.py", "catstream/video/rendered.py"),
        "catstream/sketch.py",
    ],
    "safetensors": ["catstream/messages/storage.py"],
    "obstore": ["catstream/fleet/store.py"],
    "ray": ["catstream/fleet"],
    "av": ["catstream/video"],
    "zmq": [
        "catstream/wire",
        "catstream/client/subscription.py",
    ],
    "paho": ["catstream/sinks/mqtt_sink.py"],
    "msgpack": ["catstream/wire/codec.py"],
    "msgspec": [
        *("catstream/wire/codec.py", "catstream/base/settings.py", "catstream/fleet/spec.py"),
        *("catstream/client/registry.py", "catstream/fleet/registry.py"),
        *("catstream/base/box.py", "catstream/messages"),
        *("catstream/processes/decisions.py", "catstream/compression/forest.py"),
        *("catstream/jobs/job.py", "catstream/evaluation/datasets.py"),
        *(
            "catstream/finding/results.py",
            "catstream/cli/attach.py",
            "catstream/sinks/destinations.py",
            "catstream/sinks/options.py",
        ),
        "catstream/batch.py",
    ],
    "threadpoolctl": ["catstream/base/threads.py", "catstream/reports/provenance.py"],
    "psutil": ["catstream/loadtest/latency.py"],
    "jinja2": ["catstream/reports/report.py"],
    "click": ["catstream/cli"],
    "starlette": ["catstream/web"],
    "uvicorn": ["catstream/web/server.py"],
    "prometheus_client": ["catstream/web/prometheus.py"],
    "rich": ["catstream/cli"],
}

#: Libraries that take long to import: inside the function that needs them.
SLOW = {"av", "ray", "obstore"}

#: Modules of I/O, threads, clocks and randomness, which a stage does not import.
IO_MODULES = {"asyncio", "multiprocessing", "random", "socket", "subprocess", "threading", "time", "zmq"}

#: State machines with the same rule: bytes, events and the time are arguments.
PURE = [
    *("catstream/wire/go_back_n.py", "catstream/fleet/lifecycle.py", "catstream/sinks/events.py"),
    *("catstream/processes/decisions.py", "catstream/processes/control_commands.py"),
]

FILES = sorted(ROOT.glob("catstream/**/*.py"))


def dotted(path: Path) -> str:
    """The name a file is imported by."""
    return ".".join(part for part in path.relative_to(ROOT).with_suffix("").parts if part != "__init__")


NAMES = {dotted(path) for path in FILES}


def imports(path: Path, tree: ast.AST | None = None) -> Iterator[str]:
    """Dotted names of all modules that a file imports, inside functions too."""
    for node in ast.walk(tree or ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path.name}, line {node.lineno}: write the whole name of what is imported"
            assert node.module
            for alias in node.names:
                module = f"{node.module}.{alias.name}"
                yield module if module in NAMES else node.module


def unit(module: str) -> str:
    """The folder or file below `catstream` that contains a module; empty for the package `catstream` itself."""
    return module.partition(".")[2].partition(".")[0]


def level(name: str) -> int:
    for height, names in enumerate(LEVELS):
        if name in names:
            return height
    raise AssertionError(f"{name} has no level: add it to LEVELS")


def violations(rule: Callable[[Path], Iterator[str]]) -> str:
    """The violations of a rule in all files, one line each."""
    return "\n".join(f"{path.relative_to(ROOT)}: {wrong}" for path in FILES for wrong in rule(path))


def upward(path: Path) -> Iterator[str]:
    own = unit(dotted(path))
    for module in imports(path) if own else ():  # the package exports names of all levels
        if module.partition(".")[0] != "catstream" or unit(module) == own:
            continue
        if not unit(module):
            yield "imports from the package itself: import from the module that defines the name"
        elif level(unit(module)) >= level(own):
            yield f"{own} imports {module}, but imports run downward only"


def test_the_page_shows_the_levels():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    shown = page.partition("The levels, from the top, are:\n\n```\n")[2].partition("```")[0]
    assert [set(level.replace(",", " ").split()) for level in shown.split(">")] == LEVELS[::-1]


def test_imports_run_downward_only():
    assert not violations(upward)


def misplaced(path: Path) -> Iterator[str]:
    place = str(path.relative_to(ROOT))
    for library in {module.partition(".")[0] for module in imports(path)} - sys.stdlib_module_names - {"catstream"}:
        if library not in IMPORTERS:
            yield f"imports {library}, which has no entry in IMPORTERS: add one"
        elif not any(place == home or place.startswith(f"{home}/") for home in IMPORTERS[library]):
            yield f"imports {library}, which may be imported in {' and '.join(IMPORTERS[library])} only"


def test_each_foreign_library_is_imported_in_one_place():
    assert not violations(misplaced)


def slow_at_the_top(path: Path) -> Iterator[str]:
    tree = ast.parse(path.read_text())
    top = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    for library in {module.partition(".")[0] for module in imports(path, top)} & SLOW:
        yield f"imports {library} at module level: this is slow, import it in the function that needs it"


def test_slow_libraries_are_imported_by_the_functions_that_use_them():
    assert not violations(slow_at_the_top)


@pytest.mark.parametrize("name", ["compressor", "trainer"])
def test_a_process_without_a_camera_starts_without_compiled_kernels(name):
    unused = SLOW | {"asyncio", "cv2", "numba", "sklearn"}
    check = f"import sys, catstream.processes.{name}; sys.exit({unused!r} & sys.modules.keys() or 0)"
    found = subprocess.run([sys.executable, "-P", "-c", check], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, "")


def test_the_command_track_starts_without_what_only_its_processes_need():
    unused = {"scipy", "numba", "filterpy", "sklearn", "av"}
    check = f"import sys, catstream.cli.track; sys.exit({unused!r} & sys.modules.keys() or 0)"
    found = subprocess.run([sys.executable, "-P", "-c", check], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, "")


def impure(path: Path) -> Iterator[str]:
    if (
        unit(dotted(path)) in {"features", "paper", "detection", "compression", "training"}
        or str(path.relative_to(ROOT)) in PURE
    ):
        for module in set(imports(path)) & IO_MODULES:
            yield f"imports {module}: a stage gets sockets, threads, clocks and randomness as arguments, or not at all"


def test_a_stage_imports_no_io_threads_clocks_or_randomness():
    assert not violations(impure)


@pytest.mark.parametrize(
    ("rule", "place", "source"),
    [
        (upward, "catstream/wire/codec.py", "from catstream.pipeline import Pipeline"),
        (upward, "catstream/wire/codec.py", "from catstream import Pipeline"),
        (misplaced, "catstream/base/box.py", "import an_unknown_library"),
        (misplaced, "catstream/base/box.py", "import zmq"),
        (slow_at_the_top, "catstream/base/box.py", f"import {min(SLOW)}"),
        (impure, "catstream/training/trainer.py", "def f():\n    import socket"),
        (impure, "catstream/wire/go_back_n.py", "from time import monotonic"),
    ],
)
def test_each_rule_detects_a_violation(rule, place, source, monkeypatch):
    monkeypatch.setattr(Path, "read_text", lambda _: source)
    assert list(rule(ROOT / place))


def test_every_dependency_has_an_entry():
    """The dependencies of pyproject.toml, and no others."""
    distributions = {
        "opencv-python-headless": "cv2",
        "paho-mqtt": "paho",
        "prometheus-client": "prometheus_client",
        "pyzmq": "zmq",
        "scikit-learn": "sklearn",
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(name for extra in EXTRAS for name in project["optional-dependencies"][extra])]
    names = {dependency.partition(">=")[0] for dependency in wanted}
    assert {distributions.get(name, name) for name in names} == set(IMPORTERS)
