"""Valid messages: of any kind, made from its schema, and the few that many tests send."""

from typing import Any, Literal, get_args, get_origin

import numpy as np

from catstream.base.box import Box, Window
from catstream.wire.messages import Command, Model, Preview, Track
from catstream.wire.schema import Field, Named, fields


def track(seq: int, name: str = "") -> Track:
    return Track(seq - 1, 0.0, "absent", None, 0.0, 0, object=name)


def present(seq: int, name: str = "") -> Track:
    return Track(seq - 1, seq / 30, "present", Box(1.0, 2.0, 3.0, 4.0), 0.9, 1, object=name)


def model(version: int, name: str = "") -> Model:
    return Model(version, version, np.full(5, version, np.float32), 0.0, object=name)


def example(kind: type, full: bool = True, d: int = 5) -> Any:
    """A valid message of a kind.

    Parameters
    ----------
    full : with everything that may be missing and two objects, or without and with the object without a name
    d : columns of its rows
    """
    values = {field.name: _value(field, full, d) if full or not field.optional else None for field in fields(kind)}
    if kind is Preview:
        values["jpeg"] = b"\xff\xd8\xff"
    if kind is Command:
        values |= {"verb": "set-box", "model": None, "boxes": {}} if full else {"verb": "stop", "boxes": {}}
    return kind(**values)


def _value(field: Field, full: bool, d: int) -> Any:
    if field.values is not None:
        named = field.named or Named({"sent": 0, "stored": 0})
        if field.keys.is_name:
            named = Named({"anna": 0, "ben": 0} if full else {"": 0}, frozenset({""}))
        names = [name for name in named.columns if full or name in named.required]
        return {name: _value(field.values, full, d + named.columns[name]) for name in names}
    if field.is_message:
        return example(field.type, full, d)
    if array := field.array:
        shape = [side if isinstance(side, int) else d if side == "d" else 3 * full for side in array.shape]
        return np.linspace(0.1, 0.9, int(np.prod(shape)), dtype=array.dtype).reshape(shape)
    if get_origin(field.type) is Literal:
        return get_args(field.type)[0 if full else -1]
    if get_origin(field.type) is tuple:
        return (3, 1, 0)
    if field.type in (Box, Window):
        return field.type(4.5, 3.0, 20.0, 10.0)
    text = "anna" if field.is_name and full else "" if field.is_name else "7f"
    return {bool: full, int: 4, float: 0.75, str: text, bytes: b"a file"}[field.type]
