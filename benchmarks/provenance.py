"""The provenance of measured figures: the code, the command, the settings and the machine.

As a script, it runs a command of catstream that has the option `--json`, and writes its figures with their provenance:
`python benchmarks/provenance.py benchmarks/results/loadtest.json catstream loadtest --streams 2`.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import cv2
from threadpoolctl import threadpool_info

import catstream.measure.provenance

ROOT = Path(__file__).parents[1]
_LIBRARIES = ("numpy", "scipy", "numba", "scikit-learn", "pyzmq")


def provenance(settings: Sequence[str], words: Sequence[str]) -> dict[str, object]:
    """Return the provenance of figures as a JSON object, without host name and folder names.

    The commit is that of the checkout, with -dirty if files were changed, and None if catstream runs from elsewhere;
    `settings` are those that differ from the default, NAME=VALUE; `words` are the words of the command.
    """
    return {
        "version": version("catstream"),
        "commit": _commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "command": shlex.join(map(_without_folder, words)),
        "settings": list(settings),
        "machine": machine(),
    }


def machine() -> dict[str, object]:
    """Return the machine as in a load test, and versions of the libraries."""
    blas = {
        f"{pool['internal_api']} {pool['version']} {pool.get('architecture', '')}".strip()
        for pool in threadpool_info()
        if pool["user_api"] == "blas"
    }
    return {
        **catstream.measure.provenance.provenance([])["machine"],
        "opencv": cv2.__version__,
        "blas": sorted(blas),
        **{library: version(library) for library in _LIBRARIES},
    }


def _commit() -> str | None:
    """Return the commit of the checkout. Changes of docs and measurements do not make it dirty."""
    if not (ROOT / ".git").exists():
        return None
    commit = _git("rev-parse", "--short=10", "HEAD")
    changed = _git("status", "--porcelain", "--", "catstream", "services", "benchmarks", ":!benchmarks/results")
    return f"{commit}-dirty" if commit and changed else commit


def _git(*words: str) -> str | None:
    git = shutil.which("git")
    if git is None:
        return None
    try:
        done = subprocess.run([git, "-C", str(ROOT), *words], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip() or None


def _without_folder(word: str) -> str:
    option, equals, value = word.rpartition("=")
    return f"{option}{equals}{Path(value).name}" if Path(value).is_absolute() else word


def main() -> None:
    record, *words = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "figures.json"
        subprocess.run([*words, "--json", str(file)], check=True)
        figures = json.loads(file.read_text(encoding="utf-8"))
    made = provenance(figures["settings"], [Path(words[0]).name, *words[1:]])
    Path(record).write_text(json.dumps(figures | made, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
