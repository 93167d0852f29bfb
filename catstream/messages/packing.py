"""A message as arrays and metadata, as `catstream.messages.storage` keeps them, and back: derived from its schema."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import msgspec
import numpy as np

from catstream.messages.storage import Arrays, Metadata, with_prefix

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
    metadata: Metadata = {
        field.name: _pack(getattr(message, field.name), f"{name}.{field.name}", arrays)
        for field in dataclasses.fields(message)  # type: ignore[arg-type]
    }
    return arrays, {name: entry for name, entry in metadata.items() if entry is not None}


def unpack(kind: type[Message], arrays: Arrays, metadata: Metadata, name: str) -> Message:
    """The message that `pack` took, bit for bit.

    The limits of its arrays are not checked: `catstream.messages.checks` does that.

    Raises
    ------
    TypeError, ValueError
        If the arrays and metadata are not those of a message of this kind.
    """
    whole: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(metadata))  # a copy, to put the arrays into
    for path, array in with_prefix(arrays, f"{name}.").items():
        *groups, last = path.split(".")
        place = whole
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = array
    return msgspec.convert(whole, kind, dec_hook=_array)


def _array(_: type, value: object) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise ValueError("expected an array")
    return value


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
