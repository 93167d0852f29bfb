"""Kernels, compiled to machine code once and kept in a cache folder: a second start needs no compiler."""

from __future__ import annotations

import getpass
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import numba
from numba.core.event import Event, Listener, install_listener

from catstream.features import COMPILING

__all__ = ["kernel"]

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])

_log = logging.getLogger(__name__)


def kernel(signature: str) -> Callable[[_Kernel], _Kernel]:
    """Compile a function of arrays and numbers, for these types, when its module is imported.

    Arithmetic may be reordered and nothing is checked: no index beyond the end, no division by 0.
    """
    compiler = numba.njit(signature, cache=True, nogil=True, fastmath=True, error_model="numpy")

    def compiled(function: _Kernel) -> _Kernel:
        with install_listener("numba:compile", _ANNOUNCER):
            return cast(_Kernel, compiler(function))  # numba calls it a Dispatcher

    return compiled


class _Announcer(Listener):
    """Logs `COMPILING` when the first kernel that is not in the cache is about to be compiled."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, _: Event) -> None:
        if not self._said:
            self._said = True
            _log.warning(COMPILING)

    def on_end(self, _: Event) -> None:
        pass


_ANNOUNCER = _Announcer()


def _cache_folder() -> str:
    """The folder for compiled kernels: beside the code if that is writable."""
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
    numba.config.CACHE_DIR = _cache_folder()  # type: ignore[attr-defined]  # numba sets its options at run time
