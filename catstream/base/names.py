"""Names of objects, unique within a stream. A single object may be unnamed: its name is then ""."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from typing import TypeVar
from unicodedata import category, normalize

from catstream.base.box import Box
from catstream.base.text import listed
from catstream.errors import BoxError, ObjectError

#: The name of an unnamed object.
UNNAMED = ""

#: The boxes of objects by name, or the box of one unnamed object.
Boxes = str | Iterable[float] | Mapping[str, str | Iterable[float]]

_Value = TypeVar("_Value")

_LONGEST = 64
#: Blocks of Unicode with the combining marks of living scripts; a search through all of it would take half a second.
_SCRIPTS = chain(range(0x300, 0x2100), range(0xA600, 0xAC00), range(0x11000, 0x11800), range(0x1E000, 0x1F000))
#: Vowel signs and accents, which `\w` lacks, and the two joiners of Persian and the Indic scripts.
_MARKS = "".join(mark for mark in map(chr, _SCRIPTS) if category(mark).startswith("M")) + "\u200c\u200d"
#: Regular expression of the name of an object.
PATTERN = rf"(\w[\w{_MARKS}.-]{{0,{_LONGEST - 1}}})?"


def check_name(name: str) -> str:
    """Return the name of an object in the composed form of Unicode (NFC); raise ObjectError if it is not valid.

    >>> check_name("anna-2"), check_name("Zoe\u0308")
    ('anna-2', 'Zoë')
    """
    composed = normalize("NFC", name) if isinstance(name, str) else None
    if composed is None or re.fullmatch(PATTERN, composed) is None:
        raise ObjectError(
            f"{name!r:.80} is not a name: expected text of 1 to {_LONGEST} letters, digits, '_', '-' and '.', "
            "the first of them a letter, a digit or '_'"
        )
    return str(composed)  # converts a string of numpy


def by_name(values: Mapping[str, _Value]) -> dict[str, _Value]:
    """Check the names of a mapping; ObjectError if one is not valid, or two have the same composed form.

    >>> by_name({"Zoe\u0308": 1})
    {'Zoë': 1}
    """
    checked = {check_name(name): value for name, value in values.items()}
    if len(checked) < len(values):
        raise ObjectError(
            f"two objects have one name, once with combining marks ({listed(values)}): rename one of them"
        )
    return checked


def split_name(text: str) -> tuple[str, str]:
    """Split the text NAME=VALUE; the name is "" if there is only a value.

    >>> split_name("anna=120,80,64,48"), split_name("120,80,64,48")
    (('anna', '120,80,64,48'), ('', '120,80,64,48'))
    """
    name, equals, value = text.partition("=")
    if not equals:
        return UNNAMED, text
    if not name:
        raise ObjectError(f"{text[:80]!r} has no name before the '=': write NAME={value[:60]}, or only the value")
    return check_name(name), value


def boxes_by_name(boxes: Boxes) -> dict[str, Box]:
    """The boxes of objects by name; BoxError or ObjectError if one is not valid.

    >>> boxes_by_name("120,80,64,48")
    {'': Box(x=120.0, y=80.0, w=64.0, h=48.0)}
    """
    if not isinstance(boxes, Mapping):
        return {UNNAMED: Box.parse(boxes)}
    parsed = {}
    for name, box in by_name(boxes).items():
        with errors_about(name):
            parsed[name] = Box.parse(box)
    return parsed


def check_boxes(boxes: Mapping[str, Box], width: int, height: int) -> None:
    """Raise BoxError, with the name of the object, if a box is not valid in a frame of this size."""
    for name, box in boxes.items():
        with errors_about(name):
            box.validated(width, height)


@contextmanager
def errors_about(name: str) -> Iterator[None]:
    """Prefix a BoxError with the name of its object."""
    try:
        yield
    except BoxError as error:
        raise BoxError(f"{name}: {error}" if name else str(error)) from None


def check_count(count: int, limit: int) -> None:
    """Raise ObjectError if there are more objects than allowed."""
    if count > limit:
        raise ObjectError(
            f"too many objects ({count}, limit {limit}): track fewer, or raise the limit "
            f"(--set run.max_objects={count}, up to 64)"
        )
