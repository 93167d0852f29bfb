"""Checks messages against their schema, as the annotations in `catstream.messages.kinds` state it.

The checks of a kind of message are compiled once: reading its annotations takes longer than checking a message.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, get_origin

import numpy as np

from catstream.box import Box, Window
from catstream.errors import ObjectError, ProtocolError
from catstream.messages.names import check_name
from catstream.messages.schema import (
    LARGEST_INTEGER,
    Array,
    ByObject,
    Bytes,
    Field,
    Name,
    Named,
    OnlyWith,
    Whole,
    fields,
)
from catstream.numerics.arrays import is_finite

#: The length that each letter of a shape stands for, in one message.
_Lengths = dict[str, int]
#: Raises ProtocolError unless a value keeps its limits.
_Check = Callable[[Any, _Lengths], object]


def check_message(message: object) -> _Lengths:
    """Check every field of a message.

    Types are not checked, except for dtypes: the codec checks them in messages from outside.

    Returns
    -------
    the length that each letter in the shapes of its arrays stands for

    Raises
    ------
    ProtocolError
        If a field breaks its schema.
    """
    lengths: _Lengths = {}
    kind: type = type(message)
    checks, rules = _compiled(kind)
    for name, check_value in checks:
        value = getattr(message, name)
        if value is not None:
            check_value(value, lengths)
    for rule in rules:
        rule(message)
    return lengths


@cache
def _compiled(kind: type) -> tuple[list[tuple[str, _Check]], list[Callable[[object], None]]]:
    """The check of each field that has limits, by name, and the checks of a field against another one."""
    message = kind.__name__.lower()
    checks: list[tuple[str, _Check]] = []
    rules: list[Callable[[object], None]] = []
    for field in fields(kind):
        if (checked := _check_of(field, f"{message} {field.name}")) is not None:
            checks.append((field.name, checked))
        if (rule := field.limit(OnlyWith)) is not None:
            rules.append(_only_with(message, field.name, rule))
    return checks, rules


def _check_of(field: Field, where: str) -> _Check | None:
    """The check of a value of a field, None if its type has no limits."""
    if field.values is not None:
        return _map(field, field.values, where)
    if get_origin(field.type) is tuple:
        whole = _whole(where, 0)
        return lambda values, lengths: [whole(value, lengths) for value in values]
    if field.is_message:
        return lambda message, _: check_message(message)
    if array := field.limit(Array):
        return _array(array, where)
    if limits := field.limit(Bytes):
        return _bytes(limits, where)
    if field.limit(Name):
        return _object_name(where)
    if field.type is int:
        return _whole(where, least.low if (least := field.limit(Whole)) else 0)
    return {float: _number(where), Box: _rectangle(where), Window: _rectangle(where)}.get(field.type)


def _map(field: Field, values: Field, where: str) -> _Check | None:
    """The check of a map: its names, and each value."""
    check_value, named = _check_of(values, where), field.limit(Named)
    check_object = _object_name(where) if field.limit(ByObject) else None
    if check_value is None:
        return None

    def checked(entries: dict[str, object], lengths: _Lengths) -> None:
        found = {name: check_value(entry, lengths) for name, entry in entries.items()}
        if named is not None:
            _check_names(found, named, where)
        if check_object is not None:
            for name in entries:
                check_object(name, lengths)

    return checked


def _check_names(found: dict[str, Any], named: Named, where: str) -> None:
    """Check the names of a map, and that its messages have rows of d columns, each with those that its name adds.

    Parameters
    ----------
    found : lengths of the messages, by name; of arrays None, since they share those of the message around them
    """
    if not named.required <= found.keys() <= named.columns.keys():
        expected = ", ".join(f"{name} (always)" if name in named.required else name for name in named.columns)
        raise ProtocolError(f"{where}: expected {expected}, got {', '.join(found) or 'none'}", "width")
    columns = {name: lengths["d"] for name, lengths in found.items() if lengths}
    if len({width - named.columns[name] for name, width in columns.items()}) > 1:
        expected = ", ".join(
            f"{name} of d + {more}" if more else f"{name} of d" for name, more in named.columns.items()
        )
        raise ProtocolError(f"{where}: expected columns {expected}, got {columns}", "width")


def _array(limits: Array, where: str) -> _Check:
    dtype, shape = np.dtype(limits.dtype), limits.shape
    letters = ", ".join(map(str, shape))
    bounded = any(map(math.isfinite, (limits.low, limits.high, limits.above)))

    def checked(array: np.ndarray, lengths: _Lengths) -> None:
        fits = array.ndim == len(shape) and array.dtype == dtype
        for side, length in zip(shape, array.shape, strict=False):
            fits = fits and length == (lengths.setdefault(side, length) if isinstance(side, str) else side)
        if not fits:
            raise ProtocolError(
                f"{where}: expected {dtype} ({letters}), got {array.dtype} {array.shape} with {lengths}",
                "dtype" if array.dtype != dtype else "shape",
            )
        if not limits.may_be_nan and not is_finite(array):
            raise ProtocolError(f"{where}: holds numbers that are not finite", "finite")
        if bounded and array.size:
            least, most = float(array.min()), float(array.max())
            if not (limits.low <= least and most <= limits.high and least > limits.above):
                raise ProtocolError(f"{where}: expected numbers{limits.range()}, got {least:g} to {most:g}", "range")

    return checked


def _bytes(limits: Bytes, where: str) -> _Check:
    def checked(data: bytes, _: _Lengths) -> None:
        if not (data.startswith(limits.begin) and len(data) <= limits.longest):
            raise ProtocolError(
                f"{where}: expected {limits.kind} of at most {limits.longest} bytes, got {len(data)} that begin with "
                f"{data[: len(limits.begin)]!r}"
            )

    return checked


def _whole(where: str, low: int) -> _Check:
    def checked(number: int, _: _Lengths) -> None:
        if not low <= number <= LARGEST_INTEGER:
            raise ProtocolError(f"{where}: expected a whole number from {low} to 2**53, got {number}", "range")

    return checked


def _number(where: str) -> _Check:
    def checked(number: float, _: _Lengths) -> None:
        if not math.isfinite(number):
            raise ProtocolError(f"{where}: expected a finite number, got {number}", "finite")

    return checked


def _object_name(where: str) -> _Check:
    def checked(name: str, _: _Lengths) -> None:
        try:
            check_name(name)
        except ObjectError as error:
            raise ProtocolError(f"{where}: {error}", "name") from None

    return checked


def _rectangle(where: str) -> _Check:
    def checked(box: Box | Window, _: _Lengths) -> None:
        if not (box.w > 0 and box.h > 0):
            raise ProtocolError(f"{where}: expected a width and a height above 0, got {box}", "range")
        if not all(map(math.isfinite, box)):
            raise ProtocolError(f"{where}: expected finite numbers, got {box}", "finite")

    return checked


def _only_with(kind: str, name: str, rule: OnlyWith) -> Callable[[object], None]:
    def checked(message: object) -> None:
        other = getattr(message, rule.field)
        if (getattr(message, name) is not None) != (other == rule.value):
            raise ProtocolError(f"{kind}: expected a {name} with {rule.value} and with nothing else, got {other!r}")

    return checked
