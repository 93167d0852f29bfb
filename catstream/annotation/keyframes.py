"""Boxes at keyframes as text: `NAME@FRAME=X,Y,W,H` on the command line, and files `frame,object,x,y,w,h`.

`absent` stands in the place of a box where the object is not in the frame.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from catstream.base.box import Box
from catstream.base.files import write_csv
from catstream.base.names import check_name, errors_about
from catstream.base.text import listed
from catstream.errors import BoxError, VideoError

ABSENT = "absent"

#: Name of an object, number of a frame, and the box of the object there; None if it is absent.
Keyframe = tuple[str, int, Box | None]

_HEADER = ("frame", "object", "x", "y", "w", "h")


def parse_keyframe(text: str) -> Keyframe:
    """Parse `NAME@FRAME=X,Y,W,H`, or `@FRAME=X,Y,W,H` of an object without a name. BoxError if it is malformed.

    >>> parse_keyframe("anna@412=120,80,64,48")
    ('anna', 412, Box(x=120.0, y=80.0, w=64.0, h=48.0))
    >>> parse_keyframe("@30=absent")
    ('', 30, None)
    """
    parts = re.fullmatch(r"([^@=]*)@(\d+)=(.*)", text)
    if parts is None:
        raise BoxError(f"expected NAME@FRAME=X,Y,W,H or NAME@FRAME={ABSENT}, got {text[:80]!r}")
    name, frame, box = parts.groups()
    with errors_about(check_name(name)):
        return name, int(frame), _box(box)


def format_keyframe(name: str, frame: int, box: Box | None) -> str:
    """Return the text that `parse_keyframe` parses."""
    return f"{name}@{frame}={ABSENT if box is None else ','.join(f'{side:.10g}' for side in box)}"


def read_keyframes(path: Path) -> list[Keyframe]:
    """Read a CSV file with the columns frame, object, x, y, w, h; VideoError if it cannot be read or is malformed."""
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise VideoError(
            f"cannot read the boxes in {str(path)!r} ({getattr(error, 'strerror', error)}): pass a CSV file "
            f"{','.join(_HEADER)}"
        ) from None
    return [parse_row(path, line, row) for line, row in enumerate(rows, start=2)]


def parse_row(path: Path, line: int, row: Mapping[str, str]) -> Keyframe:
    """Parse a row of a CSV file, by the names of its columns; VideoError if it is malformed."""
    try:
        box = ABSENT if row["x"] == ABSENT else ",".join(row[side] for side in "xywh")
        return check_name(row["object"]), int(row["frame"]), _box(box)
    except (KeyError, TypeError, ValueError):
        raise VideoError(
            f"{str(path)!r}, line {line}: expected the columns {','.join(_HEADER)} with a number of a frame, and a "
            f"box or {ABSENT!r} in x"
        ) from None


def write_keyframes(path: Path, keyframes: Mapping[str, Mapping[int, Box | None]]) -> None:
    """Write the file that `read_keyframes` reads, atomically, in the order of the frames."""
    places = sorted((frame, name) for name, drawn in keyframes.items() for frame in drawn)
    rows = ([frame, name, *cells(keyframes[name][frame])] for frame, name in places)
    write_csv(path, _HEADER, rows, VideoError)


def cells(box: Box | None) -> tuple[str, ...]:
    """The columns x, y, w, h of a box."""
    return (ABSENT, "", "", "") if box is None else tuple(f"{side:.10g}" for side in box)


def by_object(keyframes: Iterable[Keyframe]) -> dict[str, dict[int, Box | None]]:
    """The boxes of each object by frame; BoxError if an object has two boxes in one frame."""
    objects: dict[str, dict[int, Box | None]] = {}
    for name, frame, box in keyframes:
        drawn = objects.setdefault(name, {})
        if frame in drawn:
            raise BoxError(f"{listed([name])} has two boxes in frame {frame}: pass one of them")
        drawn[frame] = box
    return objects


def _box(text: str) -> Box | None:
    return None if text.strip() == ABSENT else Box.parse(text).checked()
