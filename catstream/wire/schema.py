"""The schema of messages: the allowed values of each field, by its annotation.

`catstream.wire.messages` contains the annotations. msgspec checks the types when bytes are decoded; `check_message`
checks the arrays, which msgspec does not support. The tables of `docs/protocol.md` and the fuzzers are derived from the
same annotations, by `fields`.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from msgspec import Meta

from catstream.base.arrays import is_finite
from catstream.base.names import PATTERN
from catstream.errors import ProtocolError

#: Length of each letter in the shapes of one message.
_Lengths = dict[str, int]

_TYPES = {name: np.dtype(name) for name in ("float32", "float64")}

Value = TypeVar("Value")
Limit = TypeVar("Limit")

LARGEST_INTEGER = 2**53  # exact in a double, for readers in any language
LONGEST_LIST = 256  # entries of a list or map: levels of a tree, counters
LONGEST_TEXT = 16384  # characters: an error may list 64 names of objects

Integer = Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)]
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]  # also excludes NaN
Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]
ObjectName = Annotated[str, Meta(pattern=rf"\A{PATTERN}\Z")]
#: Maps by the name of an object, and by any text.
ByObject = Annotated[dict[ObjectName, Value], Meta(max_length=LONGEST_LIST)]
ByText = Annotated[dict[Text, Value], Meta(max_length=LONGEST_LIST)]


@dataclass(frozen=True, slots=True)
class Array:
    """Limits of an array.

    shape       lengths of its axes; a letter means the same length in all arrays of one message
    low, high   inclusive range of its numbers
    above       exclusive lower limit of its numbers
    may_be_nan  whether numbers need not be finite, because NaN has a meaning
    """

    dtype: Literal["float32", "float64"]
    shape: tuple[int | str, ...]
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    may_be_nan: bool = False

    def range(self) -> str:
        """Description of the range of its numbers, empty without limits."""
        between = f" from {self.low:g} to {self.high:g}" if math.isfinite(self.low) else ""
        return between + (f" above {self.above:g}" if math.isfinite(self.above) else "")


@dataclass(frozen=True, slots=True)
class Named:
    """Limits of a map of arrays, or of messages with rows.

    columns   allowed names, and how many columns more than d the rows of each have; d is the same for all
    required  names that must be present
    """

    columns: Mapping[str, int]
    required: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message, parsed from its annotation.

    type          type without None and metadata
    optional      whether None is allowed
    array, named  limits of an array, and of a map
    meta          limits that msgspec checks
    is_message    whether its values are messages
    has_arrays    whether it is or contains an array
    keys, values  fields for the keys and values of a map
    """

    name: str
    type: Any
    optional: bool
    array: Array | None
    named: Named | None
    meta: Meta | None
    is_message: bool
    has_arrays: bool
    keys: Field | None = None
    values: Field | None = None

    @property
    def is_name(self) -> bool:
        """True if it is the name of an object."""
        return self.meta is not None and self.meta.pattern is not None


@cache
def fields(kind: type) -> tuple[Field, ...]:
    """The fields of a message, in their order."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(_field(field.name, hints[field.name]) for field in dataclasses.fields(kind))


def _field(name: str, hint: Any) -> Field:
    limits: tuple[object, ...] = ()
    optional = False
    while True:
        if get_origin(hint) is Annotated:
            limits += hint.__metadata__
            hint = hint.__origin__
        elif get_origin(hint) in (Union, UnionType) and NoneType in get_args(hint):
            optional = True
            (hint,) = (part for part in get_args(hint) if part is not NoneType)
        else:
            break
    keys, values = (_field(name, part) for part in get_args(hint)) if get_origin(hint) is dict else (None, None)
    is_message, array = dataclasses.is_dataclass(hint), _first(limits, Array)
    has_arrays = (
        any(field.has_arrays for field in fields(hint))
        if is_message
        else array is not None or (values is not None and values.has_arrays)
    )
    return Field(
        name, hint, optional, array, _first(limits, Named), _first(limits, Meta), is_message, has_arrays, keys, values
    )


def _first(limits: tuple[object, ...], kind: type[Limit]) -> Limit | None:
    return next((limit for limit in limits if isinstance(limit, kind)), None)


def check_message(message: object) -> _Lengths:
    """Check the arrays of a message and of its nested messages: dtypes, shapes, numbers and names.

    Returns the length of each letter in their shapes; ProtocolError if an array violates its schema.
    """
    lengths: _Lengths = {}
    kind: type = type(message)
    for field in fields(kind):
        if field.has_arrays:
            _check(field, getattr(message, field.name), lengths, f"{kind.__name__.lower()} {field.name}")
    return lengths


def _check(field: Field, value: Any, lengths: _Lengths, where: str) -> _Lengths | None:
    """Check a value of a field; returns the lengths of a nested message."""
    if value is None:
        return None
    if field.values is not None:
        lengths_of = {name: _check(field.values, entry, lengths, where) for name, entry in value.items()}
        if field.named is not None:
            _check_names(lengths_of, field.named, where)
    elif field.is_message:
        return check_message(value)
    elif field.array is not None:
        _check_array(value, field.array, lengths, where)
    return None


def _check_names(lengths_of: dict[str, _Lengths | None], named: Named, where: str) -> None:
    """Check the names of a map, and that the rows of its messages have the same d without their additional columns.

    Arrays have no lengths of their own (None): they share those of the enclosing message.
    """
    if not named.required <= lengths_of.keys() <= named.columns.keys():
        expected = ", ".join(f"{name} (always)" if name in named.required else name for name in named.columns)
        raise ProtocolError(f"{where}: expected {expected}, got {', '.join(lengths_of) or 'none'}")
    widths = {name: lengths["d"] - named.columns[name] for name, lengths in lengths_of.items() if lengths}
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
        raise ProtocolError(f"{where}: expected finite numbers, got NaN or infinity")
    if array.size and (limits.low, limits.above) != (-math.inf, -math.inf):
        least, most = float(array.min()), float(array.max())
        if not (limits.low <= least and most <= limits.high and least > limits.above):
            raise ProtocolError(f"{where}: expected numbers{limits.range()}, got {least:g} to {most:g}")
