"""The schema of messages: the allowed values of each field, as metadata of its annotation.

`catstream.messages.kinds` states the schema. The checks of `catstream.messages.checks`, the files of
`catstream.messages.packing`, the tables of `docs/protocol.md` and the fuzzers are derived from it by `fields`. Without
metadata a field has the limits that hold for all fields: a whole number is from 0 to `LARGEST_INTEGER`, a number is
finite, a text has at most `LONGEST_TEXT` bytes, a list or map has at most `LONGEST_LIST` entries, and width and height
of a box are above 0.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

Limit = TypeVar("Limit")

LARGEST_INTEGER = 2**53  # so that a reader in any language holds it exactly
LONGEST_LIST = 256  # entries of a list or map: levels of a tree, counters
LONGEST_TEXT = 4096  # bytes


@dataclass(frozen=True, slots=True)
class Array:
    """Limits of an array.

    shape       lengths of its sides; a letter stands for the same length in all arrays of one message
    low, high   its numbers are from `low` to `high`
    above       its numbers are larger than this
    may_be_nan  whether numbers may be other than finite, because NaN has a meaning
    """

    dtype: Literal["float32", "float64"]
    shape: tuple[int | str, ...]
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    may_be_nan: bool = False

    def range(self) -> str:
        """The range of its numbers in words, empty if there is none."""
        between = f" from {self.low:g} to {self.high:g}" if math.isfinite(self.low) else ""
        return between + (f" above {self.above:g}" if math.isfinite(self.above) else "")


@dataclass(frozen=True, slots=True)
class Whole:
    """The smallest value of a whole number."""

    low: int


@dataclass(frozen=True, slots=True)
class Bytes:
    """Limits of bytes: how many at most, and how they begin."""

    kind: str
    longest: int
    begin: bytes


@dataclass(frozen=True, slots=True)
class OnlyWith:
    """The field has a value if and only if another field of the message has the given one."""

    field: str
    value: str


@dataclass(frozen=True, slots=True)
class Named:
    """Limits of a map of arrays, or of messages with rows.

    columns   the names that it may have, each with its columns beyond d: with them, d is the same for all
    required  the names that it always has
    """

    columns: Mapping[str, int]
    required: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Name:
    """The text is the name of an object: see `catstream.messages.names`."""


@dataclass(frozen=True, slots=True)
class ByObject:
    """The names of the map are those of objects."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message, as its annotation states it.

    type      without None, and without metadata
    optional  whether None is allowed
    limits    the metadata
    values    of a map: what its values are
    """

    name: str
    type: Any
    optional: bool
    limits: tuple[object, ...]
    values: Field | None = None

    @property
    def is_message(self) -> bool:
        """Whether its values are messages themselves."""
        return dataclasses.is_dataclass(self.type)

    def limit(self, kind: type[Limit]) -> Limit | None:
        """The metadata of a kind, None if there is none."""
        return next((limit for limit in self.limits if isinstance(limit, kind)), None)


def fields(kind: type) -> tuple[Field, ...]:
    """The fields of a message, in their order."""
    return _fields(kind)


@cache
def _fields(kind: type) -> tuple[Field, ...]:
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
    values = _field(name, get_args(hint)[1]) if get_origin(hint) is dict else None
    return Field(name, hint, optional, limits, values)
