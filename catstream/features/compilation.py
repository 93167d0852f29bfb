"""The compiler of kernels: numba, with a cache of machine code that the second start loads.

A kernel is a loop over pixels, cells or atoms that writes into an output array of its caller. Its call releases the
GIL. Neither bounds nor divisions by 0 are checked; an array of another type than in the signature, or a read-only one,
is a TypeError.

numba invalidates the cached code of a kernel only if the kernel's own file changes. So a kernel is in one file with the
functions that it calls and the constants that it reads, and its file gives its options.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

from catstream.errors import ServiceError

try:
    import numba
    from numba.core import event
except PermissionError:
    raise ServiceError(
        "kernels cannot be compiled, as this process may not make memory executable: allow it, in a unit of systemd "
        "with MemoryDenyWriteExecute=no"
    ) from None

#: Logged at the first start after an installation, before the kernels are compiled.
COMPILING = "compiling kernels, once: about 8 s"

_Function = TypeVar("_Function", bound=Callable[..., Any])

_log = logging.getLogger(__name__)


def function(**options: Any) -> Callable[[_Function], _Function]:
    """Compile a function that is called by kernels of its file; takes the options of `numba.njit`."""
    decorate: Callable[[_Function], _Function] = numba.njit(**options)
    return decorate


def kernel(signature: str, **options: Any) -> Callable[[_Function], _Function]:
    """Compile a function for the types of a signature, or load its machine code from the cache.

    The cache is the folder NUMBA_CACHE_DIR, or else `__pycache__` next to the file of the kernel, or else the user's
    cache folder. If none of them is writable, or a file in it is damaged, every start compiles.
    """

    def compiled(function: _Function) -> _Function:
        with event.install_listener("numba:compile", _Announcement()):
            try:
                kernel = numba.njit(signature, cache=True, **options)(function)
            except Exception:  # of the cache: there is no folder, its disk is full, a file is damaged
                kernel = numba.njit(signature, **options)(function)
        return cast(_Function, kernel)

    return compiled


class _Announcement(event.Listener):
    """Logs `COMPILING` before the first kernel that is compiled."""

    def on_start(self, _: event.Event) -> None:
        _announce()

    def on_end(self, _: event.Event) -> None:
        pass


@cache
def _announce() -> None:
    _log.warning(COMPILING)
