"""Reads annotated sequences in the layouts of OTB, TLD, VOT and Princeton.

A sequence is a folder with frames, in any form that `catstream.video.source`
opens, and one of these files:

    groundtruth_rect.txt   OTB: x,y,w,h (comma, blank or tab); two objects, groundtruth_rect.1.txt and .2.txt, are
                           two sequences
    gt.txt                 TLD: x1,y1,x2,y2
    groundtruth.txt        VOT: polygons x1,y1,x2,y2 ... (their bounding box is taken), or x,y,w,h
    FOLDER.txt             Princeton: x,y,w,h,occluded, and the frames in rgb/

Each file has one line for each frame; NaN, or a box without area, means that
the object is absent. Boxes are used as published; OTB's pixel coordinates,
which start at 1, are not shifted.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.errors import VideoError
from catstream.messages.names import counted
from catstream.numerics.arrays import Float64, UInt8
from catstream.video.source import natural_order, open_source

#: First annotated frame of the OTB sequences whose ground truth starts later than their images, by name and number of
#: boxes.
_FIRST_FRAMES = {("david", 471): 299}
_RECT = re.compile(r"groundtruth_rect(\.\d+)?")  # others beside it, such as groundtruth_rect_old, are of no sequence


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """An annotated sequence.

    name   name of its folder
    path   the folder
    boxes  ground truth, float64 (frames, 4), x, y, w, h in pixels; NaN if the object is absent
    begin  frame of the source that the first box belongs to
    """

    name: str
    path: Path
    boxes: Float64
    begin: int = 0

    def __len__(self) -> int:
        return len(self.boxes)

    def frames(self, start: int = 0) -> Generator[UInt8]:
        """Yield the images of boxes[start:], uint8 (h, w, 3), one for each box.

        Raises
        ------
        VideoError
            If there are fewer frames than boxes, or a frame cannot be read.
        """
        left = len(self.boxes) - start
        with open_source(self.path, self.begin + start) as source:
            for frame in source:
                yield frame.image
                left -= 1
                if not left:
                    return
        raise VideoError(
            f"{str(self.path)!r} has {len(self.boxes)} boxes, but {counted(left, 'frame')} too few: "
            "each line of the ground truth needs a frame"
        )

    def size(self, start: int = 0) -> tuple[int, int]:
        """Read the frame of boxes[start], and return its width and height.

        Raises
        ------
        VideoError
            If it cannot be read.
        """
        with closing(self.frames(start)) as frames:
            height, width = next(frames).shape[:2]
        return width, height


def find_sequences(path: str | Path) -> list[Sequence]:
    """Return the sequence in a folder, or the sequences in its subfolders, in natural order.

    Raises
    ------
    VideoError
        If there is no sequence, or a ground truth file cannot be read.
    """
    path = Path(path)
    sequences = _sequences(path)
    if not sequences and path.is_dir():
        for folder in sorted((inner for inner in path.iterdir() if inner.is_dir()), key=natural_order):
            sequences += _sequences(folder)
    if not sequences:
        raise VideoError(
            f"there is no annotated sequence in {str(path)!r}: expected a folder of frames with groundtruth_rect.txt "
            "(x,y,w,h), gt.txt (TLD), groundtruth.txt (VOT) or FOLDER.txt (Princeton), or a folder of such folders"
        )
    return sequences


def _sequences(folder: Path) -> list[Sequence]:
    target = folder.resolve()
    name = target.name if folder.name in ("", "..") else folder.name  # a symbolic link has its own
    rects = [file for file in sorted(folder.glob("*.txt"), key=natural_order) if _RECT.fullmatch(file.stem)]
    # One of the two files of an OTB sequence with two objects is empty.
    rects = [file for file in rects if not file.exists() or file.stat().st_size] or rects
    if rects:
        ends = [file.stem.removeprefix("groundtruth_rect") if len(rects) > 1 else "" for file in rects]
        return [_sequence(name + end, folder, file, _rectangles) for file, end in zip(rects, ends, strict=True)]
    for file, reader in (
        (folder / "gt.txt", _corners),
        (folder / "groundtruth.txt", _polygons),
        (folder / f"{target.name}.txt", _rectangles),
    ):
        if file.is_file():
            return [_sequence(name, folder, file, reader)]
    return []


def _sequence(name: str, folder: Path, file: Path, reader: Callable[[Float64], Float64]) -> Sequence:
    boxes = reader(_numbers(file))
    boxes[~(np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1))] = np.nan
    if np.isnan(boxes).all():
        raise VideoError(f"{str(file)!r} has no box: the object must be present in at least one frame")
    return Sequence(name, folder, boxes, _FIRST_FRAMES.get((name.lower(), len(boxes)), 0))


def _numbers(file: Path) -> Float64:
    """Read the table in a text file, float64 (lines, columns), with at least four columns."""
    rows: list[list[float]] = []
    try:
        lines = file.read_text(encoding="utf-8-sig").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise VideoError(
            f"{str(file)!r} cannot be read ({error}): expected a text file with one line for each frame"
        ) from None
    for number, line in enumerate(lines, start=1):
        fields = line.replace(",", " ").replace(";", " ").split()
        if not fields:  # skipping the line would shift all later boxes by one frame
            raise VideoError(f"{str(file)!r}, line {number} is blank: if the object is absent, write nan,nan,nan,nan")
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        if len(row) < 4 or (rows and len(row) != len(rows[0])):
            raise VideoError(
                f"{str(file)!r}, line {number}: expected {len(rows[0]) if rows else 'four or more'} numbers, "
                f"got {line.strip()[:60]!r}"
            )
        rows.append(row)
    if not rows:
        raise VideoError(f"{str(file)!r} is empty: expected one line for each frame")
    return np.array(rows)


def _rectangles(table: Float64) -> Float64:
    return table[:, :4].copy()


def _corners(table: Float64) -> Float64:
    return np.hstack([table[:, :2], table[:, 2:4] - table[:, :2]])


def _polygons(table: Float64) -> Float64:
    if table.shape[1] < 6:
        return _rectangles(table)
    low, high = (np.stack([pick(table[:, axis::2], axis=1) for axis in (0, 1)], axis=1) for pick in (np.min, np.max))
    return np.hstack([low, high - low])
