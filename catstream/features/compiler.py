"""The compiler of kernels: numba's, and an entry by which Python calls the machine code with arrays and numbers.

The entry does what a function of a C extension does: it checks the arguments, reads numbers by Python's C-API and
arrays by the C structure that NumPy's C-API makes public, and releases the interpreter lock while the kernel runs.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FunctionType

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba.core.sigutils import normalize_signature
from numba.core.types.abstract import Type
from numba.core.types.npytypes import Array

from catstream.features.machine import ENTRY, FUNCTIONS, globals_of, target_machine

_compile = functools.partial(numba.njit, fastmath=True, error_model="numpy")
_export = functools.partial(numba.cfunc, fastmath=True, error_model="numpy")
_POINTER, _WORD, _INT = ir.PointerType(), ir.IntType(64), ir.IntType(32)
_NUMBERS = {"int64": _WORD, "float32": ir.FloatType(), "float64": ir.DoubleType()}
_HEADER = object.__basicsize__ // 8  # words of the header of every Python object
#: Words of a PyArrayObject_fields: the last one of its header, and those after it.
_TYPE, _DATA, _DIMENSIONS, _SHAPE, _STRIDES, _, _DESCR, _FLAGS = range(_HEADER - 1, _HEADER + 7)
_CHARACTERS = _HEADER + 1  # word of a PyArray_Descr: its kind, type and byteorder
_CONTIGUOUS, _ALIGNED, _WRITABLE = 0x1, 0x100, 0x400  # bits of the flags


def machine_code(name: str, function: FunctionType, signature: str) -> bytes:
    """An object file with the function `ENTRY`, which Python calls as one of a C extension (METH_FASTCALL).

    name : of the kernel, for its errors

    Raises
    ------
    TypeError
        If the function allocates or raises: the machine code would call numba
    """
    compiled = _export(signature)(_translated(function))
    module = llvm.parse_assembly(compiled.inspect_llvm())
    error = f"{name} takes writable arrays of these types: {signature}"
    types, _ = normalize_signature(signature)  # type: ignore[no-untyped-call]
    entry = llvm.parse_assembly(str(_entry(compiled.native_name, types, error)))
    taken, given = (str(each.get_function(compiled.native_name).global_value_type) for each in (module, entry))
    if taken != given:
        raise TypeError(f"this version of numba has another structure of arrays: {taken} in place of {given}")
    module.link_in(entry)
    machine = target_machine()
    _remove_unused(module, machine)
    declared = {each.name for each in module.functions if each.is_declaration and not each.name.startswith("llvm.")}
    if declared - set(FUNCTIONS):
        raise TypeError(f"{name} may allocate or raise: it calls {', '.join(declared - set(FUNCTIONS))}")
    code: bytes = machine.emit_object(module)
    return code


def _translated(function: FunctionType) -> FunctionType:
    """The function with the functions of its module that it calls compiled by numba."""
    called = {
        name: _compile(_translated(value))
        for name, value in globals_of(function).items()
        if isinstance(value, FunctionType)
    }
    return FunctionType(function.__code__, function.__globals__ | called, function.__name__)


def _remove_unused(module: llvm.ModuleRef, machine: llvm.TargetMachine) -> None:
    """Keep the entry and what it calls. The code by which numba reports errors goes if there are none."""
    for each in [*module.functions, *module.global_variables]:
        if not each.is_declaration and each.name != ENTRY:
            each.linkage = "internal"
    passes = llvm.create_new_module_pass_manager()
    passes.add_ipsccp_pass()
    passes.add_simplify_cfg_pass()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))


def _entry(callee: str, types: Sequence[Type], error: str) -> ir.Module:
    """A module with the entry, which calls the function `callee` with numba's structures in place of the arrays."""
    module = ir.Module()
    taken = [_structure_type(each.ndim) if isinstance(each, Array) else _NUMBERS[each.name] for each in types]
    kernel = ir.Function(module, ir.FunctionType(_POINTER, taken), callee)
    entry = ir.Function(module, ir.FunctionType(_POINTER, [_POINTER, _POINTER, _WORD]), ENTRY)
    builder = _Builder(entry.append_basic_block())
    _, arguments, count = entry.args
    with builder.unless(count, _WORD(len(types))):
        builder.refuse(error)
    values = []
    for place, each in enumerate(types):
        value = builder.word(arguments, place, _POINTER)
        if isinstance(each, Array):
            builder.check(value, each, error)
            values.append(builder.structure(value, each))
        else:
            values.append(builder.number(value, each))
    thread = builder.foreign("PyEval_SaveThread", _POINTER)
    builder.call(kernel, values)
    builder.foreign("PyEval_RestoreThread", ir.VoidType(), thread)
    builder.ret(builder.foreign("Py_NewRef", _POINTER, builder.object("None")))
    return module


class _Builder(ir.IRBuilder):  # type: ignore[misc]  # llvmlite has no types
    """Writes the instructions of an entry."""

    def foreign(self, name: str, result: ir.Type, *arguments: ir.Value) -> ir.Value:
        """Call a function of Python's C-API."""
        function = self.module.globals.get(name)
        if function is None:
            function = ir.Function(self.module, ir.FunctionType(result, [each.type for each in arguments]), name)
        return self.call(function, arguments)

    def object(self, name: str) -> ir.Value:
        """Address of an object of Python."""
        return self.module.globals.get(name) or ir.GlobalVariable(self.module, ir.IntType(8), name)

    def word(self, address: ir.Value, place: int, kind: ir.Type = _WORD) -> ir.Value:
        return self.load(self.gep(address, [_WORD(place)], source_etype=_WORD), typ=kind)

    @contextmanager
    def unless(self, value: ir.Value, expected: ir.Value) -> Iterator[None]:
        """A block for a value that differs from the expected one."""
        with self.if_then(self.icmp_unsigned("!=", value, expected), likely=False):
            yield

    def refuse(self, error: str) -> None:
        """Raise a TypeError."""
        text = ir.Constant(ir.ArrayType(ir.IntType(8), len(error) + 1), bytearray(f"{error}\0".encode()))
        variable = ir.GlobalVariable(self.module, text.type, self.module.get_unique_name("error"))
        variable.initializer, variable.global_constant = text, True
        self.foreign("PyErr_SetString", ir.VoidType(), self.object("TypeError"), variable)
        self.ret(_POINTER(None))

    def number(self, value: ir.Value, kind: Type) -> ir.Value:
        """A Python number as one of C."""
        if kind.name == "int64":
            number = self.foreign("PyLong_AsLongLong", _WORD, value)
        else:
            number = self.foreign("PyFloat_AsDouble", ir.DoubleType(), value)
        with self.unless(self.foreign("PyErr_Occurred", _POINTER), _POINTER(None)):
            self.ret(_POINTER(None))
        return self.fptrunc(number, ir.FloatType()) if kind.name == "float32" else number

    def check(self, array: ir.Value, kind: Array, error: str) -> None:
        """Refuse an object that is no array, or one of another type."""
        dtype = np.dtype(kind.dtype.name)
        characters = int.from_bytes(f"{dtype.kind}{dtype.char}{dtype.byteorder}".encode(), "little")
        flags = _ALIGNED | _WRITABLE | _CONTIGUOUS * kind.is_c_contig
        with self.unless(self.word(array, _TYPE, _POINTER), self.object("ndarray")):
            self.refuse(error)
        with self.unless(self.word(array, _DIMENSIONS, _INT), _INT(kind.ndim)):
            self.refuse(error)
        with self.unless(self.and_(self.word(array, _FLAGS, _INT), _INT(flags)), _INT(flags)):
            self.refuse(error)
        found = self.word(self.word(array, _DESCR, _POINTER), _CHARACTERS, _INT)
        with self.unless(self.and_(found, _INT(0xFFFFFF)), _INT(characters)):
            self.refuse(error)

    def structure(self, array: ir.Value, kind: Array) -> ir.Value:
        """An array as numba's structure, which owns nothing."""
        size = _WORD(1)
        shape = strides = ir.Constant(ir.ArrayType(_WORD, kind.ndim), None)
        for axis in range(kind.ndim):
            length = self.word(self.word(array, _SHAPE, _POINTER), axis)
            stride = self.word(self.word(array, _STRIDES, _POINTER), axis)
            size = self.mul(size, length)
            shape, strides = self.insert_value(shape, length, axis), self.insert_value(strides, stride, axis)
        item = _WORD(np.dtype(kind.dtype.name).itemsize)
        structure = ir.Constant(_structure_type(kind.ndim), None)
        for place, value in enumerate((size, item, self.word(array, _DATA, _POINTER), shape, strides), start=2):
            structure = self.insert_value(structure, value, place)
        return structure


def _structure_type(dimensions: int) -> ir.LiteralStructType:
    """numba's structure of an array: two owners, number and size of its elements, address, shape, strides."""
    lengths = ir.ArrayType(_WORD, dimensions)
    return ir.LiteralStructType([_POINTER, _POINTER, _WORD, _WORD, _POINTER, lengths, lengths])
