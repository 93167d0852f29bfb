"""Checks the arrays of messages against the limits in the annotations of `catstream.messages.kinds`."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from catstream.errors import ProtocolError
from catstream.messages.schema import Array, Field, Named, fields
from catstream.numerics.arrays import is_finite

#: The length that each letter of a shape stands for, in one message.
_Lengths = dict[str, int]

_TYPES = {name: np.dtype(name) for name in ("float32", "float64")}


def check_message(message: object) -> _Lengths:
    """Check the arrays of a message, and of the messages in it: dtypes, shapes, numbers and names.

    Returns
    -------
    the length that each letter in the shapes of its arrays stands for

    Raises
    ------
    ProtocolError
        If an array breaks its schema.
    """
    lengths: _Lengths = {}
    for field in _with_arrays(type(message)):
        _check(field, getattr(message, field.name), lengths, f"{type(message).__name__.lower()} {field.name}")
    return lengths


@cache
def _with_arrays(kind: type) -> tuple[Field, ...]:
    return tuple(field for field in fields(kind) if field.has_arrays)


def _check(field: Field, value: Any, lengths: _Lengths, where: str) -> _Lengths | None:
    """Check a value of a field; returns the lengths of a message of its own."""
    if value is None:
        return None
    if field.values is not None:
        found = {name: _check(field.values, entry, lengths, where) for name, entry in value.items()}
        if (named := field.limit(Named)) is not None:
            _check_names(found, named, where)
    elif field.is_message:
        return check_message(value)
    elif (limits := field.limit(Array)) is not None:
        _check_array(value, limits, lengths, where)
    return None


def _check_names(found: dict[str, _Lengths | None], named: Named, where: str) -> None:
    """Check the names of a map, and that its messages have rows of d columns, each with those that its name adds.

    Parameters
    ----------
    found : lengths of the messages, by name; of arrays None, since they share those of the message around them
    """
    if not named.required <= found.keys() <= named.columns.keys():
        expected = ", ".join(f"{name} (always)" if name in named.required else name for name in named.columns)
        raise ProtocolError(f"{where}: expected {expected}, got {', '.join(found) or 'none'}")
    widths = {name: lengths["d"] - named.columns[name] for name, lengths in found.items() if lengths}
    if len(set(widths.values())) > 1:
        raise ProtocolError(f"{where}: expected rows of one length, got {widths} without their labels")


def _check_array(array: np.ndarray, limits: Array, lengths: _Lengths, where: str) -> None:
    fits = array.ndim == len(limits.shape) and array.dtype == _TYPES[limits.dtype]
    for side, length in zip(limits.shape, array.shape, strict=False):
        fits = fits and length == (lengths.setdefault(side, length) if isinstance(side, str) else side)
    if not fits:
        letters = ", ".join(map(str, limits.shape))
        raise ProtocolError(
            f"{where}: expected {limits.dtype} ({letters}), got {array.dtype} {array.shape} with {lengths}"
        )
    if not limits.may_be_nan and not is_finite(array):
        raise ProtocolError(f"{where}: holds numbers that are not finite")
    if array.size and (limits.low, limits.above) != (-math.inf, -math.inf):
        least, most = float(array.min()), float(array.max())
        if not (limits.low <= least and most <= limits.high and least > limits.above):
            raise ProtocolError(f"{where}: expected numbers{limits.range()}, got {least:g} to {most:g}")
