"""What figures were made with: the code, the command, the settings and the machine.

A file of figures carries this, so that it can be read years later beside another one. No host name and no folder of the
machine is in it.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_info

from catstream.evaluation.peers import OPENCV
from catstream.settings import Settings

__all__ = ["machine", "provenance"]

_ROOT = Path(__file__).parents[2]
_LIBRARIES = ("numpy", "scipy", "numba", "scikit-learn", "pyzmq")


def provenance(settings: Settings, words: Sequence[str] | None = None) -> dict[str, Any]:
    """What figures are made with, as JSON holds it.

    Parameters
    ----------
    settings : those that hold for all of the figures
    words : the command; None for the one that started this process

    Returns
    -------
    version    of catstream
    commit     of the checkout that it runs from, with -dirty if that was changed; None if it is installed elsewhere
    date       of today, UTC
    command    as it was typed, with the last part only of each absolute path
    settings   those that differ from their default
    machine    see `machine`
    """
    given = [Path(sys.argv[0]).name, *sys.argv[1:]] if words is None else words
    return {
        "version": version("catstream"),
        "commit": _commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "command": shlex.join(map(_without_folder, given)),
        "settings": settings.changed(),
        "machine": machine(),
    }


def machine() -> dict[str, Any]:
    """Processor, cores that this process may use, GB of memory, and the versions of what does the arithmetic."""
    blas = {
        f"{pool['internal_api']} {pool['version']} {pool.get('architecture', '')}".strip()
        for pool in threadpool_info()
        if pool["user_api"] == "blas"
    }
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9),
        "system": platform.system(),
        "python": platform.python_version(),
        "opencv": OPENCV,
        "blas": sorted(blas),
        **_versions(),
    }


def _versions() -> dict[str, str]:
    """Of the libraries that are installed."""
    versions = {}
    for library in _LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[library] = version(library)
    return versions


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _commit() -> str | None:
    """Of the code: measurements that lie in the checkout, and its docs, do not count as changes."""
    if not (_ROOT / ".git").exists():
        return None
    commit = _git("rev-parse", "--short=10", "HEAD")
    changed = _git("status", "--porcelain", "--", "catstream", "services", "benchmarks", ":!benchmarks/results")
    return f"{commit}-dirty" if commit and changed else commit


def _git(*words: str) -> str | None:
    git = shutil.which("git")
    if git is None:
        return None
    try:
        done = subprocess.run([git, "-C", str(_ROOT), *words], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip() or None


def _without_folder(word: str) -> str:
    option, equals, value = word.rpartition("=")
    return f"{option}{equals}{Path(value).name}" if Path(value).is_absolute() else word
