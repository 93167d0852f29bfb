"""Names and the processor of kernels, shared by their compiler and their calls."""

from __future__ import annotations

import functools
import inspect
from types import FunctionType
from typing import Any

import llvmlite.binding as llvm

ENTRY = "kernel"  #: name of the function in the machine code
#: Functions of Python's C-API that the machine code may call.
FUNCTIONS = (
    "PyErr_Occurred",
    "PyErr_SetString",
    "PyEval_RestoreThread",
    "PyEval_SaveThread",
    "PyFloat_AsDouble",
    "PyLong_AsLongLong",
    "Py_NewRef",
)


def globals_of(function: FunctionType) -> dict[str, Any]:
    """The values that a function reads from its module, by name."""
    return dict(inspect.getclosurevars(function).globals)


@functools.cache
def target_machine() -> llvm.TargetMachine:
    """This processor, for LLVM to make the fastest machine code for it."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = processor()
    options = {"cpu": cpu, "features": features, "opt": 3, "codemodel": "jitdefault", "jit": True}
    return llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(**options)


def processor() -> tuple[str, str]:
    """Its name, and what it can do."""
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
