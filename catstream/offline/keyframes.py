"""Boxes at keyframes as text: `NAME@FRAME=X,Y,W,H` on the command line, and files `frame,object,x,y,w,h`.

Instead of a box, `absent` means that the object is not in the frame, and `hidden` that it is too occluded for a box.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, Literal

from catstream.base.box import Box
from catstream.base.names import check_name, errors_about
from catstream.base.tables import Row, read_table, write_table
from catstream.base.text import listed
from catstream.errors import BoxError, VideoError

ABSENT = "absent"
HIDDEN: Final = "hidden"

#: The box of an object at a keyframe; None if it is absent, "hidden" if it is too occluded for a box.
KeyframeBox = Box | Literal["hidden"] | None

#: Name of an object, number of a frame, and the object's box in this frame.
Keyframe = tuple[str, int, KeyframeBox]

_HEADER = ("frame", "object", "x", "y", "w", "h", "file")


def parse_keyframe(text: str) -> Keyframe:
    """Parse `NAME@FRAME=X,Y,W,H`, or `@FRAME=X,Y,W,H` for an object without a name; BoxError if it is malformed.

    >>> parse_keyframe("anna@412=120,80,64,48")
    ('anna', 412, Box(x=120.0, y=80.0, w=64.0, h=48.0))
    >>> parse_keyframe("@30=absent")
    ('', 30, None)
    >>> parse_keyframe("anna@99=hidden")
    ('anna', 99, 'hidden')
    """
    parts = re.fullmatch(r"([^@=]*)@(\d+)=(.*)", text)
    if parts is None:
        raise BoxError(f"expected NAME@FRAME=X,Y,W,H, NAME@FRAME={ABSENT} or NAME@FRAME={HIDDEN}, got {text[:80]!r}")
    name, frame, box = parts.groups()
    with errors_about(check_name(name)):
        return name, int(frame), parse_box(box)


def format_keyframe(name: str, frame: int, box: KeyframeBox) -> str:
    """Format a keyframe for `parse_keyframe`."""
    return f"{name}@{frame}={','.join(filter(None, cells(box)))}"


def read_keyframes(path: Path) -> list[Keyframe]:
    """Read a table with the columns frame, object, x, y, w, h; VideoError if it cannot be read or is malformed."""
    return read_table(path, _HEADER[:-1], parse_row)


def parse_row(row: Row, frame: int | None = None) -> Keyframe:
    """Parse a row of a table, with a default for an empty frame; ValueError if it is malformed."""
    word = row.text("x").lower()
    box = parse_box(word if word in (ABSENT, HIDDEN) else [row.number(side) for side in "xywh"])
    if (number := row.integer("frame", frame)) < 0:
        raise ValueError(f"column frame: expected a number from 0, got {number}")
    return check_name(row.text("object")), number, box


def write_keyframes(path: Path, keyframes: Mapping[str, Mapping[int, KeyframeBox]], video: str = "") -> None:
    """Write a table for `read_keyframes` and for a batch, atomically, in the order of the frames."""
    file = video and os.path.relpath(video, path.parent)
    order = sorted((frame, name) for name, drawn in keyframes.items() for frame in drawn)
    rows = ([frame, name, *cells(keyframes[name][frame]), file] for frame, name in order)
    write_table(path, _HEADER, rows, VideoError)


def cells(box: KeyframeBox) -> tuple[str, ...]:
    """The cells x, y, w, h of a box."""
    return tuple(f"{side:.10g}" for side in box) if isinstance(box, Box) else (box or ABSENT, "", "", "")


def by_object(keyframes: Iterable[Keyframe]) -> dict[str, dict[int, KeyframeBox]]:
    """The boxes of each object by frame; BoxError if an object has two boxes in one frame."""
    objects: dict[str, dict[int, KeyframeBox]] = {}
    for name, frame, box in keyframes:
        drawn = objects.setdefault(name, {})
        if frame in drawn:
            raise BoxError(f"{listed([name])} has two boxes in frame {frame}: pass one of them")
        drawn[frame] = box
    return objects


def parse_box(box: str | Iterable[float]) -> KeyframeBox:
    """Parse a box, four numbers or a text that may be `absent` or `hidden`. BoxError if it is malformed."""
    if isinstance(box, str) and box.strip() in (ABSENT, HIDDEN):
        return None if box.strip() == ABSENT else HIDDEN
    return Box.parse(box).checked()
