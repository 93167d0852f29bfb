"""The compiler of kernels: numba's, and an entry by which ctypes calls the machine code with NumPy arrays.

The entry reads the arrays itself, from the C structure that NumPy's C-API makes public, as `numpy.ndarray.ctypes` and
its like take longer than many a kernel.
"""

from __future__ import annotations

import functools
from types import FunctionType

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir

from catstream.features.compiled import ARRAY_TYPE, ENTRY, Parameter, globals_of, parameters, target_machine

__all__ = ["machine_code"]

_compile = functools.partial(numba.njit, fastmath=True, error_model="numpy")
_export = functools.partial(numba.cfunc, fastmath=True, error_model="numpy")
_POINTER, _WORD, _INT = ir.PointerType(), ir.IntType(64), ir.IntType(32)
_NUMBERS = {"int64": _WORD, "float32": ir.FloatType(), "float64": ir.DoubleType()}
_HEADER = object.__basicsize__ // 8  # words of the header of every Python object
#: Words of a PyArrayObject_fields: the last one of its header, and those after it.
_TYPE, _DATA, _DIMENSIONS, _SHAPE, _STRIDES, _, _DESCR, _FLAGS = range(_HEADER - 1, _HEADER + 7)
_CHARACTERS = _HEADER + 1  # word of a PyArray_Descr: its kind, type and byteorder
_CONTIGUOUS, _ALIGNED, _WRITABLE = 0x1, 0x100, 0x400  # bits of the flags


def machine_code(function: FunctionType, signature: str) -> bytes:
    """An object file with the function `ENTRY` (parameters ...): 0, or 1 if an array is of another type.

    Raises
    ------
    TypeError
        If the function allocates or raises: the machine code would call numba
    """
    compiled = _export(signature)(_translated(function))
    module = llvm.parse_assembly(compiled.inspect_llvm())
    entry = llvm.parse_assembly(str(_entry(compiled.native_name, parameters(signature))))
    taken, given = (str(each.get_function(compiled.native_name).global_value_type) for each in (module, entry))
    if taken != given:
        raise TypeError(f"this version of numba has another structure of arrays: {taken} in place of {given}")
    module.link_in(entry)
    machine = target_machine()
    _remove_unused(module, machine)
    foreign = [each.name for each in module.functions if each.is_declaration and not each.name.startswith("llvm.")]
    if foreign:
        raise TypeError(f"{function.__qualname__} may allocate or raise: it calls {', '.join(foreign)}")
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


def _entry(callee: str, types: list[Parameter]) -> ir.Module:
    """A module with the entry, which calls the function `callee` with numba's structures in place of the arrays."""
    module = ir.Module()
    ndarray = ir.GlobalVariable(module, ir.IntType(8), ARRAY_TYPE)
    taken = [_structure_type(each.dimensions) if each.dimensions else _NUMBERS[each.dtype] for each in types]
    kernel = ir.Function(module, ir.FunctionType(_POINTER, taken), callee)
    given = [_POINTER if each.dimensions else _NUMBERS[each.dtype] for each in types]
    entry = ir.Function(module, ir.FunctionType(_INT, given), ENTRY)
    builder = ir.IRBuilder(entry.append_basic_block())
    parameters = list(zip(entry.args, types, strict=True))
    for value, each in parameters:
        if each.dimensions:
            _check(builder, value, ndarray, each)
    builder.call(kernel, [_structure(builder, value, each) if each.dimensions else value for value, each in parameters])
    builder.ret(_INT(0))
    return module


def _structure_type(dimensions: int) -> ir.LiteralStructType:
    """numba's structure of an array: two owners, number and size of its elements, address, shape, strides."""
    lengths = ir.ArrayType(_WORD, dimensions)
    return ir.LiteralStructType([_POINTER, _POINTER, _WORD, _WORD, _POINTER, lengths, lengths])


def _check(builder: ir.IRBuilder, array: ir.Value, ndarray: ir.Value, parameter: Parameter) -> None:
    """Return 1 from the entry if an object is no array, or one of another type."""
    dtype = np.dtype(parameter.dtype)
    characters = int.from_bytes(f"{dtype.kind}{dtype.char}{dtype.byteorder}".encode(), "little")
    flags = _ALIGNED | _WRITABLE | _CONTIGUOUS * parameter.contiguous

    def require(value: ir.Value, expected: ir.Value) -> None:
        with builder.if_then(builder.icmp_unsigned("!=", value, expected), likely=False):
            builder.ret(_INT(1))

    require(_word(builder, array, _TYPE, _POINTER), ndarray)
    require(_word(builder, array, _DIMENSIONS, _INT), _INT(parameter.dimensions))
    require(builder.and_(_word(builder, array, _FLAGS, _INT), _INT(flags)), _INT(flags))
    descr = _word(builder, array, _DESCR, _POINTER)
    require(builder.and_(_word(builder, descr, _CHARACTERS, _INT), _INT(0xFFFFFF)), _INT(characters))


def _structure(builder: ir.IRBuilder, array: ir.Value, parameter: Parameter) -> ir.Value:
    """An array as numba's structure, which owns nothing."""
    size = _WORD(1)
    shape = strides = ir.Constant(ir.ArrayType(_WORD, parameter.dimensions), None)
    for axis in range(parameter.dimensions):
        length = _word(builder, _word(builder, array, _SHAPE, _POINTER), axis)
        stride = _word(builder, _word(builder, array, _STRIDES, _POINTER), axis)
        size = builder.mul(size, length)
        shape, strides = builder.insert_value(shape, length, axis), builder.insert_value(strides, stride, axis)
    item = _WORD(np.dtype(parameter.dtype).itemsize)
    structure = ir.Constant(_structure_type(parameter.dimensions), None)
    for place, value in enumerate((size, item, _word(builder, array, _DATA, _POINTER), shape, strides), start=2):
        structure = builder.insert_value(structure, value, place)
    return structure


def _word(builder: ir.IRBuilder, address: ir.Value, place: int, kind: ir.Type = _WORD) -> ir.Value:
    return builder.load(builder.gep(address, [_WORD(place)], source_etype=_WORD), typ=kind)
