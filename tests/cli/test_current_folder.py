"""No command imports a file of the current folder."""

import subprocess
import sys
from pathlib import Path

import pytest

from catstream.cli import COMMANDS

CATSTREAM = Path(sys.executable).with_name("catstream")

#: Modules that the processes import: of libraries, of the standard library, of catstream, and of the start of Python.
TRAPS = [
    *("av", "click", "cv2", "msgspec", "numba", "numpy", "psutil", "rich", "safetensors", "scipy", "zmq"),
    *("asyncio", "json", "logging", "multiprocessing", "random", "select", "signal", "socket", "subprocess", "typing"),
    *("catstream/__init__", "processes/__init__", "sitecustomize", "usercustomize"),
]

EVERY_COMMAND = """
import sys
from click.testing import CliRunner
from catstream.cli import group
for name in sys.argv[1:]:
    assert CliRunner().invoke(group, [name, "--help"]).exit_code == 0, name
"""

PROGRAM = """
import sys, catstream
if __name__ == "__main__":
    with catstream.Pipeline(sys.argv[1], sys.argv[2]) as pipeline:
        assert len(list(pipeline)) == int(sys.argv[3])
"""


@pytest.fixture
def traps(tmp_path):
    """A folder with a trap for each module; each writes a file if it is imported."""
    folder = tmp_path / "traps"
    for name in TRAPS:
        path = folder / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("import pathlib; pathlib.Path(__file__ + '.sprung').touch()\n")
    return folder


@pytest.mark.parametrize("name", ["track", "evaluate", "loadtest", "program", "all others"])
def test_no_file_in_the_current_folder_is_imported(name, walk, traps, tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    images, out = walk / "img", tmp_path / "out"
    box = (walk / "groundtruth_rect.txt").read_text().splitlines()[0]
    load = ["--rate", "20", "--duration", "1", "--size", "160x120", "--subscribers", "1", "--limit", "skipped=1"]
    command = {
        "track": [CATSTREAM, "track", images, "--box", box, "--output", out],
        "evaluate": [CATSTREAM, "evaluate", walk, "--jobs", "2", "--json", tmp_path / "x.json"],
        "loadtest": [CATSTREAM, "loadtest", *load],
        "program": [sys.executable, tmp_path / "program.py", images, box, "12"],
        "all others": [sys.executable, "-P", "-c", EVERY_COMMAND, *COMMANDS],
    }[name]
    done = subprocess.run(command, cwd=traps, capture_output=True, text=True, timeout=500, check=False)
    assert not [str(path.relative_to(traps)) for path in traps.rglob("*.sprung")]
    assert done.returncode == 0, done.stderr
