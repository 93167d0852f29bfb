"""Kernels, compiled to machine code once and kept in a cache folder: a second start needs no compiler."""

from __future__ import annotations

import getpass
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba

__all__ = ["kernel"]


def kernel(signature: str) -> Callable:
    """Compile a function of arrays and numbers, for these types, when its module is imported.

    Arithmetic may be reordered and nothing is checked: no index beyond the end, no division by 0.
    """
    return numba.njit(signature, cache=True, nogil=True, fastmath=True, error_model="numpy")


def _cache_folder() -> str:
    """Where compiled kernels are kept: beside the code only if that can be written."""
    beside = Path(__file__).parent
    if os.access(beside, os.W_OK):
        return str(beside / "__pycache__")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    for folder in (Path(home) / "catstream", Path(tempfile.gettempdir()) / f"catstream-{getpass.getuser()}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return str(beside / "__pycache__")


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = _cache_folder()  # type: ignore[attr-defined]
