"""Annotated sequences in the layouts of public data sets.

A sequence is a folder with frames, in any form that `catstream.video.source`
opens, and one of these files:

    groundtruth_rect.txt   OTB: x,y,w,h (comma, semicolon, blank or tab); two objects, groundtruth_rect.1.txt and
                           .2.txt, are two sequences
    gt.txt                 TLD: x1,y1,x2,y2
    groundtruth.txt        VOT: polygons x1,y1,x2,y2 ... (replaced by their bounding boxes), or x,y,w,h, as in
                           LaSOT and GOT-10k
    FOLDER.txt             Princeton: x,y,w,h,occluded, and the frames in rgb/

Each file has one line for each frame. The object is absent if its box is NaN or
has no area, or by the flag files of a data set, in which boxes of frames without
the object repeat the last one: see `_ABSENCE`. Boxes are used as published; OTB's
pixel coordinates, which start at 1, are not shifted.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catstream.base.arrays import Bool, Float64, UInt8
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.measure.scores import present
from catstream.video.images import natural_order
from catstream.video.source import open_source

#: First annotated frame of OTB sequences with more images than boxes, by name and number of boxes.
_FIRST_FRAMES = {("david", 471): 299}
_RECT = re.compile(r"groundtruth_rect(\.\d+)?\.txt")

#: Files with a number for each frame, and the test of a number for the absence of the object.
_ABSENCE: dict[str, Callable[[Float64], Bool]] = {
    **dict.fromkeys(("full_occlusion.txt", "out_of_view.txt"), lambda flags: flags != 0),  # LaSOT
    "absence.label": lambda flags: flags != 0,  # GOT-10k
    "cover.label": lambda levels: levels == 0,  # GOT-10k: eighths of the object that are visible
    **dict.fromkeys(("full-occlusion.tag", "out-of-frame.tag"), lambda flags: flags != 0),  # VOT, CDTB
}


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """An annotated sequence.

    name   name of its folder
    path   the folder
    boxes  ground truth, float64 (frames, 4), x, y, w, h in pixels; NaN if the object is absent
    begin  frame of the first box in the source
    """

    name: str
    path: Path
    boxes: Float64
    begin: int = 0

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def present(self) -> Bool:
        """True for each frame with the object, bool (frames,)."""
        return present(self.boxes)

    def since(self, frame: int) -> Sequence:
        """Return the part from a frame on, with the same name."""
        return Sequence(self.name, self.path, self.boxes[frame:], self.begin + frame)

    def frames(self) -> Generator[UInt8]:
        """Yield the images, uint8 (h, w, 3), one for each box; VideoError if there are too few."""
        missing = len(self.boxes)
        with open_source(self.path, self.begin) as source:
            for frame in source:
                yield frame.image
                missing -= 1
                if not missing:
                    return
        raise VideoError(
            f"{str(self.path)!r} has fewer frames than boxes ({len(self.boxes) - missing} of {len(self.boxes)}): "
            "each line of the ground truth needs a frame"
        )


def find_sequences(*paths: str | Path, failed: Callable[[VideoError], None] | None = None) -> list[Sequence]:
    """Return the unique sequences in folders or in their subfolders, in natural order.

    failed : function that is called with the error of each sequence that cannot be read; if None, the error is raised
    """
    truths: dict[Path, _Truth] = {}  # by the file
    for path in map(Path, paths):
        folders = sorted(path.glob("[!.]*/"), key=natural_order)
        annotated = _truths(path) or [truth for folder in folders for truth in _truths(folder)]
        if not annotated:
            raise VideoError(
                f"there is no annotated sequence in {str(path)!r}: expected a folder of frames with "
                "groundtruth_rect.txt (x,y,w,h), gt.txt (TLD), groundtruth.txt (VOT, LaSOT, GOT-10k) or FOLDER.txt "
                "(Princeton), or a folder of such folders"
            )
        for truth in annotated:
            truths.setdefault(truth.file.resolve(), truth)
    sequences = []
    for truth in truths.values():
        try:
            sequences.append(_sequence(truth))
        except VideoError as error:
            if failed is None:
                raise
            failed(error)
    return sequences


class _Layout(NamedTuple):
    """The layout of a ground truth: description of a line, possible numbers of columns, and conversion to boxes."""

    line: str
    columns: Collection[int]
    boxes: Callable[[Float64], Float64]


def _rectangles(table: Float64) -> Float64:
    return table[:, :4].copy()


def _corners(table: Float64) -> Float64:
    boxes = np.hstack([table[:, :2], table[:, 2:] - table[:, :2]])
    if (boxes[:, 2:] < 0).any():
        line = int((boxes[:, 2:] < 0).any(axis=1).argmax()) + 1
        raise ValueError(f"line {line} has x2 < x1 or y2 < y1: if it is x,y,w,h, name the file groundtruth_rect.txt")
    return boxes


def _polygons(table: Float64) -> Float64:
    if table.shape[1] == 4:
        return _rectangles(table)
    points = table.reshape(len(table), -1, 2)
    low, high = points.min(axis=1), points.max(axis=1)
    return np.hstack([low, high - low])


_OTB = _Layout("x,y,w,h", (4,), _rectangles)
_TLD = _Layout("x1,y1,x2,y2", (4,), _corners)
_VOT = _Layout("x,y,w,h or the corners of a polygon, x1,y1,x2,y2 ...", range(4, 1000, 2), _polygons)
_PRINCETON = _Layout("x,y,w,h or x,y,w,h,occluded", (4, 5), _rectangles)


class _Truth(NamedTuple):
    """The ground truth of a sequence: the name and the folder of the sequence, the file, and its layout."""

    name: str
    folder: Path
    file: Path
    layout: _Layout


def _truths(folder: Path) -> list[_Truth]:
    """Return the ground truth of each sequence in a folder."""
    target = folder.resolve()
    name = target.name if folder.name in ("", "..") else folder.name  # the name of a symbolic link, not its target's
    rects = [
        file
        for file in sorted(folder.glob("*.txt"), key=natural_order)
        if _RECT.fullmatch(file.name) and file.is_file()
    ]
    # One of the two files of an OTB sequence with two objects is empty.
    rects = [file for file in rects if file.stat().st_size] or rects
    if rects:
        ends = [file.stem.removeprefix("groundtruth_rect") if len(rects) > 1 else "" for file in rects]
        return [_Truth(name + end, folder, file, _OTB) for file, end in zip(rects, ends, strict=True)]
    for file, layout in {"gt.txt": _TLD, "groundtruth.txt": _VOT, f"{target.name}.txt": _PRINCETON}.items():
        if (folder / file).is_file():
            return [_Truth(name, folder, folder / file, layout)]
    return []


def _sequence(truth: _Truth) -> Sequence:
    name, folder, file, layout = truth
    try:
        boxes = layout.boxes(_numbers(file, layout))
    except ValueError as error:
        raise VideoError(f"{str(file)!r}: {error}") from None
    boxes[_absent(folder, len(boxes))] = np.nan
    boxes[~present(boxes) | (boxes[:, 2:] <= 0).any(axis=1)] = np.nan
    sequence = Sequence(name, folder, boxes, _FIRST_FRAMES.get((name.lower(), len(boxes)), 0))
    if (count := sequence.present.sum()) < 2:  # a run starts with the initial box
        raise VideoError(
            f"{str(file)!r} has {'one box' if count else 'no box'}: expected a line with {layout.line} for each "
            "frame, and the object in at least two frames"
        )
    return sequence


def _absent(folder: Path, frames: int) -> Bool:
    """Read the flags of absence in the folder of a sequence, bool (frames,)."""
    absent = np.zeros(frames, bool)
    for file in (folder / name for name in _ABSENCE):
        if not file.is_file():
            continue
        try:
            flags = np.array(re.split(r"[\s,]+", _text(file).strip()), float)
        except ValueError:
            raise VideoError(f"{str(file)!r} is not a list of numbers: expected one for each frame") from None
        if len(flags) != frames:
            raise VideoError(
                f"{str(file)!r} has {counted(len(flags), 'number')} for {frames} boxes: expected one for each box"
            )
        absent |= _ABSENCE[file.name](flags)
    return absent


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig").rstrip()
    except (OSError, UnicodeDecodeError) as error:
        cause = getattr(error, "strerror", None) or error
        raise VideoError(
            f"{str(file)!r} cannot be read ({cause}): expected a text file with one line for each frame"
        ) from None


def _numbers(file: Path, layout: _Layout) -> Float64:
    """Read the table in a text file, float64 (lines, columns)."""
    rows: list[list[float]] = []
    for number, line in enumerate(_text(file).splitlines(), start=1):
        if not line.strip():  # skipping it would shift all later boxes by one frame
            raise VideoError(f"{str(file)!r}, line {number} is blank: if the object is absent, write nan,nan,nan,nan")
        try:
            row = [float(field) for field in re.split(r"\s*[,;]\s*|\s+", line.strip(" \t,;"))]
        except ValueError:
            row = []
        if len(row) not in ([len(rows[0])] if rows else layout.columns):
            expected = f"{len(rows[0])} numbers as in line 1" if rows else layout.line
            raise VideoError(
                f"{str(file)!r}, line {number}: expected {expected}, with decimal points, got {line.strip()[:60]!r}"
            )
        rows.append(row)
    if not rows:
        raise VideoError(f"{str(file)!r} is empty: expected one line for each frame")
    return np.array(rows)
