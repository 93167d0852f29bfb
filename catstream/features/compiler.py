"""The compiler of kernels: numba's, and an entry by which ctypes calls the machine code with NumPy arrays.

The entry reads the arrays itself, from the C structure that NumPy's C-API makes public, as `numpy.ndarray.ctypes` and
its like take longer than many a kernel.
"""

from __future__ import annotations

import functools
import inspect
from types import FunctionType

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir

from catstream.features.compiled import ENTRY, Parameter, names_in, parameters, target_machine

__all__ = ["machine_code"]

_compile = functools.partial(numba.njit, fastmath=True, error_model="numpy")
_export = functools.partial(numba.cfunc, fastmath=True, error_model="numpy")
_POINTER, _WORD, _INT = ir.PointerType(), ir.IntType(64), ir.IntType(32)
_HEADER = object.__basicsize__ // 8  # words of the header of a Python object; the last one is its type
#: Words of PyArrayObject_fields, and the word of PyArray_Descr with the characters kind, type and byteorder.
_DATA, _DIMENSIONS, _SHAPE, _STRIDES, _, _DESCR, _FLAGS = range(_HEADER, _HEADER + 7)
_KIND = _HEADER + 1
_CONTIGUOUS, _ALIGNED, _WRITABLE = 0x1, 0x100, 0x400  # bits of the flags


def machine_code(function: FunctionType, signature: str) -> bytes:
    """An object file with the function `ENTRY` (ndarray, parameters ...): 0, or 1 if an array is of another type.

    Raises
    ------
    TypeError
        If the function allocates or raises: the machine code would call numba
    """
    compiled = _export(signature)(_translated(function))
    module = llvm.parse_assembly(compiled.inspect_llvm())
    (wrapper,) = [each for each in module.functions if each.name == compiled.native_name]
    module.link_in(llvm.parse_assembly(str(_entry(wrapper.name, parameters(signature)))))
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
        name: _compile(_translated(inspect.unwrap(value)))
        for name, value in names_in(function).items()
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


def _entry(wrapper: str, parameters: list[Parameter]) -> ir.Module:
    """A module with the entry, which calls a function `wrapper` that takes arrays as numba's structures."""
    module = ir.Module()
    numbers = {"int64": _WORD, "float32": ir.FloatType(), "float64": ir.DoubleType()}
    given = [_POINTER if each.dimensions else numbers[each.dtype] for each in parameters]
    taken = [_array_type(each.dimensions) if each.dimensions else numbers[each.dtype] for each in parameters]
    function = ir.Function(module, ir.FunctionType(_INT, [_POINTER, *given]), ENTRY)
    kernel = ir.Function(module, ir.FunctionType(_POINTER, taken), wrapper)
    ndarray, *arguments = function.args
    builder = ir.IRBuilder(function.append_basic_block())

    def word(address: ir.Value, place: int, kind: ir.Type = _WORD) -> ir.Value:
        return builder.load(builder.gep(address, [ir.Constant(_WORD, place)], source_etype=_WORD), typ=kind)

    def check(value: ir.Value, expected: ir.Value | int) -> None:
        wanted = ir.Constant(value.type, expected) if isinstance(expected, int) else expected
        with builder.if_then(builder.icmp_unsigned("!=", value, wanted), likely=False):
            builder.ret(ir.Constant(_INT, 1))

    def masked(value: ir.Value, mask: int) -> ir.Value:
        return builder.and_(value, ir.Constant(_INT, mask))

    def structure(address: ir.Value, parameter: Parameter) -> ir.Value:
        shape, strides = word(address, _SHAPE, _POINTER), word(address, _STRIDES, _POINTER)
        size, array = ir.Constant(_WORD, 1), ir.Constant(_array_type(parameter.dimensions), ir.Undefined)
        for axis in range(parameter.dimensions):
            length = word(shape, axis)
            size = builder.mul(size, length)
            array = builder.insert_value(array, length, [5, axis])
            array = builder.insert_value(array, word(strides, axis), [6, axis])
        values = [
            ir.Constant(_POINTER, None),
            ir.Constant(_POINTER, None),
            size,
            ir.Constant(_WORD, np.dtype(parameter.dtype).itemsize),
            word(address, _DATA, _POINTER),
        ]
        for place, value in enumerate(values):
            array = builder.insert_value(array, value, place)
        return array

    for address, parameter in zip(arguments, parameters, strict=True):
        if parameter.dimensions:
            dtype = np.dtype(parameter.dtype)
            characters = int.from_bytes(f"{dtype.kind}{dtype.char}{dtype.byteorder}".encode(), "little")
            flags = _ALIGNED | _WRITABLE | _CONTIGUOUS * parameter.contiguous
            check(word(address, _HEADER - 1, _POINTER), ndarray)
            check(word(address, _DIMENSIONS, _INT), parameter.dimensions)
            check(masked(word(address, _FLAGS, _INT), flags), flags)
            check(masked(word(word(address, _DESCR, _POINTER), _KIND, _INT), 0xFFFFFF), characters)
    builder.call(
        kernel,
        [
            structure(argument, each) if each.dimensions else argument
            for argument, each in zip(arguments, parameters, strict=True)
        ],
    )
    builder.ret(ir.Constant(_INT, 0))
    return module


def _array_type(dimensions: int) -> ir.Type:
    """numba's structure of an array: two owners, number and size of its elements, address, shape, strides."""
    lengths = ir.ArrayType(_WORD, dimensions)
    return ir.LiteralStructType([_POINTER, _POINTER, _WORD, _WORD, _POINTER, lengths, lengths])
