"""The schema of messages: the allowed values of each field, by its annotation.

`catstream.messages.kinds` states the schema. The types here are checked by msgspec where bytes become a message; the
limits of arrays, which msgspec does not know, by `catstream.messages.checks`. The tables of `docs/protocol.md` and the
fuzzers are derived from the same annotations, by `fields`.
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

from msgspec import Meta

from catstream.messages.names import PATTERN

Limit = TypeVar("Limit")
Value = TypeVar("Value")

LARGEST_INTEGER = 2**53  # so that a reader in any language holds it exactly
LONGEST_LIST = 256  # entries of a list or map: levels of a tree, counters
LONGEST_TEXT = 16384  # characters: the names of 64 objects, and what is to be said about them

Integer = Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)]
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]  # NaN is outside, too
Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]
ObjectName = Annotated[str, Meta(pattern=rf"\A{PATTERN}\Z")]
#: A map of something by the name of an object, and by any text.
ByObject = Annotated[dict[ObjectName, Value], Meta(max_length=LONGEST_LIST)]
ByText = Annotated[dict[Text, Value], Meta(max_length=LONGEST_LIST)]


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
class Named:
    """Limits of a map of arrays, or of messages with rows.

    columns   the names that it may have, each with its columns beyond d: with them, d is the same for all
    required  the names that it always has
    """

    columns: Mapping[str, int]
    required: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message, as its annotation states it.

    type          without None, and without metadata
    optional      whether None is allowed
    limits        the metadata
    keys, values  of a map: what its names and its values are
    """

    name: str
    type: Any
    optional: bool
    limits: tuple[object, ...]
    keys: Field | None = None
    values: Field | None = None

    @property
    def is_message(self) -> bool:
        """Whether its values are messages themselves."""
        return dataclasses.is_dataclass(self.type)

    @property
    def has_arrays(self) -> bool:
        """Whether it is an array, or holds some."""
        if self.is_message:
            return any(field.has_arrays for field in fields(self.type))
        return self.limit(Array) is not None or (self.values is not None and self.values.has_arrays)

    def limit(self, kind: type[Limit]) -> Limit | None:
        """The metadata of a kind, None if there is none."""
        return next((limit for limit in self.limits if isinstance(limit, kind)), None)


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
    keys, values = (_field(name, each) for each in get_args(hint)) if get_origin(hint) is dict else (None, None)
    return Field(name, hint, optional, limits, keys, values)
