"""Kernels: functions compiled to machine code once. Later starts load the machine code and import no compiler.

The machine code of a kernel is a file in the cache folder. The name of the file contains a digest of everything that
the machine code depends on, so a file is never out of date. A file that is damaged is replaced.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import getpass
import hashlib
import inspect
import logging
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NamedTuple, TypeVar, cast

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from catstream.features import COMPILING

__all__ = ["ENTRY", "Parameter", "kernel", "names_in", "parameters", "target_machine"]

_Function = TypeVar("_Function", bound=Callable[..., None])

_log = logging.getLogger(__name__)

ENTRY = "kernel"  #: name of the function in the machine code
_NUMBERS = {"int64": ctypes.c_int64, "float32": ctypes.c_float, "float64": ctypes.c_double}
_DIGEST_BYTES = hashlib.sha256().digest_size


class Parameter(NamedTuple):
    """The type of a kernel's parameter.

    dtype       name of the dtype of the number or array
    dimensions  of the array; 0 for a number
    contiguous  if the array has to be C-contiguous
    """

    dtype: str
    dimensions: int
    contiguous: bool


def parameters(signature: str) -> list[Parameter]:
    """Parameters of a kernel.

    >>> parameters("void(uint8[:,::1])")
    [Parameter(dtype='uint8', dimensions=2, contiguous=True)]
    """
    found = re.findall(r"(\w+)(?:\[([:,1]+)\])?", signature.removeprefix("void"))
    return [Parameter(dtype, axes.count(",") + 1 if axes else 0, axes.endswith("::1")) for dtype, axes in found]


def kernel(signature: str) -> Callable[[_Function], _Function]:
    """Compile a function of arrays and numbers for these types, or load its machine code, when its module is imported.

    A kernel returns nothing, allocates no array and raises nothing. It may call functions of its module and read
    constants of it. Arithmetic may be reordered and nothing is checked: no index beyond the end, no division by 0.
    Other threads run during a call.

    Parameters
    ----------
    signature : "void(uint8[:,::1], float64)", for example: a C-contiguous array of two dimensions, and a number. The
        numbers are int64, float32 and float64, in Python int and float. An array without `::1` may have any strides.

    Raises
    ------
    TypeError
        From a call with an array of another type, or one that cannot be written
    """
    types: list[Any] = [ctypes.py_object if each.dimensions else _NUMBERS[each.dtype] for each in parameters(signature)]
    prototype = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.py_object, *types)

    def compiled(function: _Function) -> _Function:
        name = f"{function.__module__}.{function.__qualname__}"
        native = prototype(_load(name, cast(FunctionType, function), signature))

        @functools.wraps(function)
        def call(*arguments: object) -> None:
            if native(np.ndarray, *arguments):
                raise TypeError(f"{name} takes writable arrays of these types: {signature}")

        return cast(_Function, call)

    return compiled


def names_in(function: FunctionType) -> dict[str, Any]:
    """What a function reads from its module, by name.

    >>> names_in(names_in).keys()
    dict_keys([])
    """
    return {name: function.__globals__[name] for name in function.__code__.co_names if name in function.__globals__}


@functools.cache
def target_machine() -> llvm.TargetMachine:
    """This processor, for which machine code is made as fast as it can be."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    options = {"cpu": cpu, "features": features, "opt": 3, "codemodel": "jitdefault", "jit": True}
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(**options)


def _described(value: object) -> Iterator[bytes]:
    """Everything of a name's value that machine code depends on."""
    if isinstance(value, FunctionType):
        function = inspect.unwrap(value)
        code = function.__code__
        yield repr((code.co_code, code.co_consts, code.co_names, code.co_varnames)).encode()
        for name, read in names_in(function).items():
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


def _load(name: str, function: FunctionType, signature: str) -> int:
    """Address of the machine code of a kernel, from the cache if it is there."""
    file = _FOLDER / f"{name}.{_digest(function, signature)}.kernel"
    code = _read(file)
    if code is None:
        _announce()
        from catstream.features.compiler import machine_code

        code = machine_code(function, signature)
        _write(file, code)
    library = llvm.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol(ENTRY)
    linked = library.link(_linker(), name)
    _LINKED.append(linked)
    return int(linked[ENTRY])


def _digest(function: FunctionType, signature: str) -> str:
    """A digest of all that machine code depends on."""
    digest = hashlib.sha256(_environment())
    for part in (signature.encode(), *_described(function)):
        digest.update(b"%d:%s" % (len(part), part))
    return digest.hexdigest()[:32]


@functools.cache
def _environment() -> bytes:
    """The compiler and the processor that it compiles for."""
    machine = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    compiler = Path(__file__).with_name("compiler.py").read_bytes()
    return repr((sys.implementation.cache_tag, version("numba"), llvmlite.__version__, machine, compiler)).encode()


@functools.cache
def _linker() -> llvm.LLJIT:
    return llvm.create_lljit_compiler(target_machine())


def _read(file: Path) -> bytes | None:
    """The machine code in a file; None if there is none, or it is damaged."""
    try:
        data = file.read_bytes()
    except OSError:
        return None
    digest, code = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    return code if hashlib.sha256(code).digest() == digest else None


def _write(file: Path, code: bytes) -> None:
    """Replace a file atomically. If that fails, the kernel is compiled again at the next start."""
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, prefix=f".{file.name}.", delete=False) as part:
            try:
                part.write(hashlib.sha256(code).digest() + code)
                part.close()
                Path(part.name).replace(file)
            except OSError:
                Path(part.name).unlink()


@functools.cache
def _announce() -> None:
    """Log `COMPILING`, once."""
    _log.warning(COMPILING)


def _cache_folder() -> Path:
    """The folder for compiled kernels: beside the code if that is writable."""
    beside = Path(__file__).parent
    if os.access(beside, os.W_OK):
        return beside / "__pycache__"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    for folder in (Path(home) / "catstream", Path(tempfile.gettempdir()) / f"catstream-{getpass.getuser()}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return beside / "__pycache__"


_FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or _cache_folder())
_LINKED: list[llvm.ResourceTracker] = []  # machine code is freed with its tracker
