"""A message as arrays and metadata, as `catstream.messages.storage` keeps them, and back: derived from its schema."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, TypeVar, get_args, get_origin

import numpy as np

from catstream.box import Box, Window
from catstream.messages.schema import Array, Field, fields
from catstream.messages.storage import Arrays, Metadata

Message = TypeVar("Message")


def pack(message: object, name: str) -> tuple[Arrays, Metadata]:
    """Arrays, their names beginning with `name`, and metadata for JSON.

    Examples
    --------
    >>> from catstream.messages.kinds import Motion
    >>> arrays, metadata = pack(Motion(np.eye(4), np.eye(2)), "motion")
    >>> list(arrays), metadata
    (['motion.process', 'motion.observation'], {})
    >>> unpack(Motion, arrays, metadata, "motion").observation.tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    arrays: Arrays = {}
    metadata = {
        field.name: _pack(getattr(message, field.name), f"{name}.{field.name}", arrays)
        for field in fields(type(message))
    }
    return arrays, {name: entry for name, entry in metadata.items() if entry is not None}


def unpack(kind: type[Message], arrays: Arrays, metadata: Metadata, name: str) -> Message:
    """The message that `pack` took, bit for bit.

    Its limits are not checked: `catstream.messages.checks` does that.

    Raises
    ------
    AttributeError, KeyError, TypeError, ValueError
        If the arrays and metadata are not those of a message of this kind.
    """
    values = {
        field.name: _unpack(field, metadata.get(field.name), f"{name}.{field.name}", arrays) for field in fields(kind)
    }
    return kind(**values)


def _pack(value: object, name: str, arrays: Arrays) -> object:
    """The entry that stands for a value, None if there is none; its arrays are added to `arrays`."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return None
    if isinstance(value, dict):
        return {key: _pack(entry, f"{name}.{key}", arrays) for key, entry in value.items()}
    if dataclasses.is_dataclass(value):
        parts, metadata = pack(value, name)
        arrays.update(parts)
        return metadata
    return list(value) if isinstance(value, tuple) else value


def _unpack(field: Field, entry: Any, name: str, arrays: Arrays) -> object:
    if field.limit(Array) is not None:
        return arrays.get(name) if field.optional else arrays[name]
    if entry is None and field.optional:
        return None
    if field.values is not None:
        return {key: _unpack(field.values, value, f"{name}.{key}", arrays) for key, value in entry.items()}
    if field.is_message:
        return unpack(field.type, arrays, entry, name)
    if field.type in (Box, Window):
        return field.type(*map(float, entry))
    if get_origin(field.type) is tuple:
        return tuple(map(int, entry))
    if get_origin(field.type) is Literal:
        if entry not in get_args(field.type):
            raise ValueError(f"{name} is {entry!r:.40}, not one of {', '.join(get_args(field.type))}")
        return entry
    return field.type(entry)
