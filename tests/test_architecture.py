"""The rules of imports in `docs/architecture.md`: downward only, and each foreign library in one place."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

#: The levels of docs/architecture.md, the lowest first. A module imports from lower levels and its own folder.
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
SHOWN = PAGE.partition("The levels, from the top:\n\n```\n")[2].partition("```")[0]
LEVELS = [set(names.replace(",", " ").split()) for names in reversed(SHOWN.split(">"))]

#: The files or folders of catstream/ that may import a foreign library; empty: all.
IMPORTERS = {
    "numpy": "",
    "scipy": "base/threads.py base/ridge.py coreset/reduce.py",
    "cv2": "base/threads.py detection features processes/detector.py output/events.py video",
    "filterpy": "training/motion_em.py",
    "numba": "features/compilation.py",
    "sklearn": "detection/scm.py sketch.py training/one_class.py video/rendered.py",
    "safetensors": "wire/storage.py",
    "obstore": "fleet/store.py",
    "ray": "fleet",
    "av": "measure/load_video.py measure/mjpeg.py video",
    "zmq": "client/subscription.py wire",
    "paho": "output/mqtt_sink.py",
    "msgpack": "wire/codec.py",
    "msgspec": "",
    "threadpoolctl": "base/threads.py",
    "psutil": "fleet/fleet.py measure/latency.py",
    "jinja2": "output/report.py",
    "click": "cli",
    "starlette": "web",
    "uvicorn": "web/server.py",
    "prometheus_client": "web/prometheus.py web/latency.py",
    "rich": "cli",
}

#: Modules of I/O, threads, clocks and randomness, which a stage does not import.
IO_MODULES = {"asyncio", "multiprocessing", "random", "socket", "subprocess", "threading", "time", "zmq"}

#: Folders of the stages, and state machines with the same rule: bytes, events and the time are arguments.
STAGES = {"features", "detection", "coreset", "training"}
PURE = "wire/go_back_n.py output/events.py processes/decisions.py processes/control_commands.py"

FILES = sorted(ROOT.glob("catstream/**/*.py"))


def dotted(path: Path) -> str:
    """The name a file is imported by."""
    return ".".join(part for part in path.relative_to(ROOT).with_suffix("").parts if part != "__init__")


NAMES = {dotted(path) for path in FILES}


def imports(path: Path) -> Iterator[str]:
    """Dotted names of all modules that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
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
    raise AssertionError(f"{name} has no level: add it to the levels in docs/architecture.md")


def upward(path: Path) -> Iterator[str]:
    own = unit(dotted(path))
    for module in imports(path) if own else ():  # the package exports names of all levels
        if module.partition(".")[0] != "catstream" or unit(module) == own:
            continue
        if not unit(module):
            yield "imports from the package itself: import from the module that defines the name"
        elif level(unit(module)) >= level(own):
            yield f"{own} imports {module}, but imports run downward only"


def misplaced(path: Path) -> Iterator[str]:
    place = str(path.relative_to(ROOT / "catstream"))
    for library in {module.partition(".")[0] for module in imports(path)} - sys.stdlib_module_names - {"catstream"}:
        homes = IMPORTERS.get(library, "nowhere").split()
        if homes and not any(place == home or place.startswith(f"{home}/") for home in homes):
            yield f"imports {library}, which IMPORTERS does not allow here"


def impure(path: Path) -> Iterator[str]:
    if unit(dotted(path)) in STAGES or str(path.relative_to(ROOT / "catstream")) in PURE.split():
        for module in set(imports(path)) & IO_MODULES:
            yield f"imports {module}: a stage gets sockets, threads, clocks and randomness as arguments, or not at all"


@pytest.mark.parametrize("rule", [upward, misplaced, impure], ids=["downward", "one home", "stages without I/O"])
def test_imports_follow_the_rule(rule):
    violations = [f"{path.relative_to(ROOT)}: {wrong}" for path in FILES for wrong in rule(path)]
    assert not violations, "\n".join(violations)


@pytest.mark.parametrize(
    ("start", "unused"),
    [
        ("import catstream; catstream.Tracker()", {"asyncio", "filterpy", "sklearn", "av"}),
        ("import catstream.processes.compressor", {"asyncio", "cv2", "filterpy", "numba", "sklearn", "av"}),
        ("import catstream.processes.trainer", {"asyncio", "cv2", "filterpy", "numba", "sklearn", "av"}),
        ("import catstream.cli, catstream.pipeline", {"asyncio", "msgspec", "numpy", "rich", "zmq"}),
        ("import catstream.cli.track", {"asyncio", "filterpy", "rich", "scipy", "numba", "sklearn", "av"}),
    ],
)
def test_program_starts_without_unneeded_slow_libraries(start, unused):
    check = f"import sys; {start}; sys.exit({unused!r} & sys.modules.keys() or 0)"
    found = subprocess.run([sys.executable, "-P", "-c", check], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, "")
