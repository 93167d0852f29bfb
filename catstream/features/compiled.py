"""Kernels: functions compiled to machine code once. Later starts load the machine code and import no compiler.

The machine code of a kernel is a file in the cache folder. The name of the file contains a digest of everything that
the machine code depends on, so a file is never out of date. A file that is damaged is replaced.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import version
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TypeVar, cast

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from catstream.features import COMPILING
from catstream.features.machine import ENTRY, FUNCTIONS, globals_of, processor, target_machine

_Function = TypeVar("_Function", bound=Callable[..., None])

_METH_FASTCALL = 0x80
_NEW_FUNCTION = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)(
    ("PyCFunction_NewEx", ctypes.pythonapi)
)
_DIGEST_BYTES = hashlib.sha256().digest_size

_log = logging.getLogger(__name__)


def kernel(signature: str) -> Callable[[_Function], _Function]:
    """Compile a function of arrays and numbers for these types, or load its machine code, when its module is imported.

    A kernel returns nothing, allocates no array and raises nothing. It may call functions of its module, which are
    compiled with it, and read the module's constants. Arithmetic may be reordered and nothing is checked: no index
    beyond the end, no division by 0. Other threads run during a call.

    Parameters
    ----------
    signature : "void(uint8[:,::1], float64)", for example: a C-contiguous array of two dimensions, and a number. The
        numbers are int64, float32 and float64. An array without `::1` may have any strides.

    Raises
    ------
    TypeError
        From a call with an array of another type, or one that cannot be written
    """

    def compiled(function: _Function) -> _Function:
        name = f"{function.__module__}.{function.__qualname__}"
        loaded = _load(name, cast(FunctionType, function), signature)
        method = _Method(function.__name__.encode(), loaded[ENTRY], _METH_FASTCALL, (function.__doc__ or "").encode())
        _LOADED.append((loaded, method))
        return cast(_Function, _NEW_FUNCTION(ctypes.addressof(method), None, None))

    return compiled


class _Method(ctypes.Structure):
    """PyMethodDef, which makes a function of C one of Python."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


def _load(name: str, function: FunctionType, signature: str) -> llvm.ResourceTracker:
    """The machine code of a kernel, which is compiled if the cache has none."""
    file = _FOLDER / f"{name}.{_digest(name, function, signature)}.kernel"
    code = _read(file)
    if code is None:
        _announce()
        from catstream.features.compiler import machine_code

        code = machine_code(name, function, signature)
        _write(file, code)
    library = llvm.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol(ENTRY)
    for symbol, address in _addresses().items():
        library.import_symbol(symbol, address)
    return library.link(_linker(), f"{name}.{len(_LOADED)}")  # a name cannot be used twice


@functools.cache
def _addresses() -> dict[str, int]:
    """Addresses of what machine code uses of Python."""
    functions = {name: ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p).value or 0 for name in FUNCTIONS}
    return functions | {each.__name__: id(each) for each in (np.ndarray, TypeError)} | {"None": id(None)}


@functools.cache
def _linker() -> llvm.LLJIT:
    return llvm.create_lljit_compiler(target_machine(), use_jit_link=True)


def _digest(name: str, function: FunctionType, signature: str) -> str:
    """A digest of all that machine code depends on."""
    digest = hashlib.sha256()
    for part in (_compiler(), repr(processor()).encode(), name.encode(), signature.encode(), *_described(function)):
        digest.update(b"%d:%s" % (len(part), part))
    return digest.hexdigest()[:32]


@functools.cache
def _compiler() -> bytes:
    """Versions of the compiler and of Python's binary interface, and the source code here."""
    sources = [Path(__file__).with_name(name).read_bytes() for name in ("compiled.py", "compiler.py", "machine.py")]
    return repr((EXTENSION_SUFFIXES[0], version("numba"), llvmlite.__version__, sources)).encode()


def _described(value: object) -> Iterator[bytes]:
    """Everything of a kernel, or of a value that it reads, that machine code depends on."""
    if isinstance(value, FunctionType):
        code = value.__code__
        yield repr((code.co_code, code.co_consts, code.co_names, code.co_varnames)).encode()
        for name, read in sorted(globals_of(value).items()):
            yield name.encode()
            yield from _described(read)
    elif isinstance(value, np.ndarray):
        yield repr((value.dtype.str, value.shape)).encode()
        yield value.tobytes()
    elif isinstance(value, ModuleType | type):
        yield value.__name__.encode()
    elif isinstance(value, int | float | np.generic):
        yield repr(value).encode()
    else:
        raise TypeError(f"a kernel reads numbers, arrays and functions of its module, and no {type(value).__name__}")


def _read(file: Path) -> bytes | None:
    """The machine code in a file; None if there is none, or it is damaged."""
    try:
        data = file.read_bytes()
    except OSError:
        return None
    digest, code = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    return code if hashlib.sha256(code).digest() == digest else None


def _write(file: Path, code: bytes) -> None:
    """Replace a file atomically. If it cannot be written, the next start compiles the kernel again."""
    part = file.with_name(f".{file.name}.{os.urandom(8).hex()}")
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(hashlib.sha256(code).digest() + code)
            part.replace(file)
        finally:
            part.unlink(missing_ok=True)


@functools.cache
def _announce() -> None:
    """Log `COMPILING` before the first kernel that is compiled."""
    _log.warning(COMPILING)


def _cache_folder() -> Path:
    """The folder for compiled kernels: beside the code if that is writable, or one that belongs to this user alone."""
    beside = Path(__file__).parent
    if os.access(beside, os.W_OK):
        return beside / "__pycache__"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    for folder in (Path(home) / "catstream", Path(tempfile.gettempdir()) / f"catstream-{os.getuid()}"):
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK) and folder.stat().st_uid == os.getuid():
                return folder
    return beside / "__pycache__"


_FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or _cache_folder())
_LOADED: list[tuple[llvm.ResourceTracker, _Method]] = []  # memory of the functions of C
