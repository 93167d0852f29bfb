"""Writes the fields of the messages and the table of the trees into protocol.md, from the schemas: `make protocol`."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from textwrap import fill
from typing import Any, Literal, get_args, get_origin

from catstream.base.box import Box, Window
from catstream.wire.codec import KINDS
from catstream.wire.heads import TREES
from catstream.wire.messages import (
    Motion,
    ObjectFeatures,
    Position,
    StreamStatus,
    Summary,
    Tracks,
    TrainingRows,
)
from catstream.wire.schema import fields

PAGE = Path(__file__).with_name("protocol.md")

_PARTS = (Motion, ObjectFeatures, StreamStatus, Summary, TrainingRows)
_INTERNAL = {Position, Tracks}  # between the processes of a pipeline: no subscriber sees them
MESSAGES = [*(kind for kind in KINDS.values() if kind not in _INTERNAL), *_PARTS]
_PLAIN = {int: "integer", float: "number", str: "text", bool: "boolean", Box: "box", Window: "window"}


def filled(page: str) -> str:
    """Return the page with the fields of all messages and the table of trees.

    ValueError if a message has no section with a list.
    """
    for kind in MESSAGES:
        name = kind.__name__.lower()
        section = re.compile(rf"(^### `{name}`\n(?:(?!^###? ).*\n)*?)((?:^(?:- |  )\S.*\n)+)", re.MULTILINE)
        if (found := section.search(page)) is None:
            raise ValueError(f"docs/protocol.md has no list of fields in a section on {name}")
        page = page[: found.start(2)] + _listed(kind) + page[found.end(2) :]
    return re.sub(r"^\| tree \|.*\n(\|.*\n)+", lambda _: _trees(), page, flags=re.MULTILINE)


def _listed(kind: type) -> str:
    """The list of the fields of a message: types and limits from its schema, meanings from its docstring."""
    parameters = r"^(\w+)(?: : .*\n +|  +)(\S.*(?:\n +\S.*)*)"
    meanings = dict(re.findall(parameters, inspect.cleandoc(kind.__doc__ or ""), re.MULTILINE))
    rows = []
    for field in fields(kind):
        meaning = re.sub(r"\s+", " ", meanings[field.name]).replace("None", "nil").rstrip(".")
        described = f" ({_kind_of(field)}{' or nil' if field.optional else ''})"
        row = f"`{field.name}`{'' if meaning == 'name of the object' else described}: {meaning[0].lower()}{meaning[1:]}"
        rows.append(fill(row, 128, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False) + "\n")
    return "".join(rows)


def _kind_of(field: Any) -> str:
    """The type of a field and its limits, in words."""
    if field.values is not None:
        keys = "object" if field.keys.is_name else _names_of(field.named)
        kind, _, inner = _kind_of(field.values).partition(" by ")
        return f"{kind} by {keys}" + (f" and {inner}" if inner else "")
    if field.is_name:
        return "name of an object"
    if field.is_message:
        return f"`{field.type.__name__.lower()}`" if field.type in MESSAGES else "map"
    if array := field.array:
        nan = ", may be NaN" if array.may_be_nan else ""
        return f"{array.dtype} ({', '.join(map(str, array.shape))}){array.range()}{nan}"
    limits = field.meta
    if get_origin(field.type) is Literal:
        return f"text: {', '.join(f'`{value}`' for value in get_args(field.type))}"
    if get_origin(field.type) is tuple:
        return "array of integers"
    if field.type is bytes:
        return f"bytes, at most {limits.max_length}"
    least = f", at least {limits.ge}" if field.type is int and limits is not None and limits.ge else ""
    return _PLAIN[field.type] + least


def _names_of(named: Any) -> str:
    if named is None:
        return "name"
    return ", ".join(f"`{name}`" + (" (always)" if name in named.required else "") for name in named.columns)


def _trees() -> str:
    """The table of trees."""
    rows = ["| tree | group of training rows | rows | columns | used for |\n| --- | --- | --- | --- | --- |\n"]
    for name, tree in TREES.items():
        used = ", ".join(f"`heads.{head.name}`" for head in tree.heads if not head.adds_to_score) or "score"
        label = "all" if tree.label is None else f"label {tree.label:g}"
        columns = f"d + {tree.more_columns}" if tree.more_columns else "d"
        rows.append(f"| `{name}` | `{tree.group}` | {label} | {columns} | {used} |\n")
    return "".join(rows)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
