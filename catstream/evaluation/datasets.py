"""Annotated sequences, in the layouts that people have them in.

A sequence is a folder with frames (whatever `catstream.video.source` opens) and
one of these files:

    groundtruth_rect.txt   OTB: x,y,w,h (comma, blank or tab); two objects, groundtruth_rect.1.txt and .2.txt, are
                           two sequences
    gt.txt                 TLD: x1,y1,x2,y2
    groundtruth.txt        VOT: polygons x1,y1,x2,y2 ... (their bounding box is taken), or x,y,w,h
    FOLDER.txt             Princeton: x,y,w,h,occluded, and the frames in rgb/

Each has a line a frame; NaN, or a box without area, says that the object is
absent. Boxes are taken as published: that OTB counts pixels from 1 stays so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.errors import VideoError
from catstream.video.source import natural_order, open_source

__all__ = ["Sequence", "find_sequences"]

#: Sequences of OTB whose truth does not begin with their first image, by name and number of boxes.
_FIRST_FRAMES = {("david", 471): 299}


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """Frames, and where the object is in each.

    name   that of its folder
    path   the folder
    boxes  float64 (frames, 4), x, y, w, h in pixels; NaN where the object is absent
    begin  frame of the source that the first box belongs to
    """

    name: str
    path: Path
    boxes: np.ndarray
    begin: int = 0

    def __len__(self) -> int:
        return len(self.boxes)

    def frames(self, start: int = 0) -> Iterator[np.ndarray]:
        """Images, uint8 (h, w, 3), of boxes[start:], one a box.

        Raises
        ------
        VideoError
            Where there are fewer frames than boxes, or they cannot be read.
        """
        left = len(self.boxes) - start
        with open_source(self.path, self.begin + start) as source:
            for frame in source:
                yield frame.image
                left -= 1
                if not left:
                    return
        raise VideoError(
            f"{str(self.path)!r} has {len(self.boxes)} boxes and {left} frames too few for them: "
            "each line of the truth needs its frame"
        )


def find_sequences(path: str | Path) -> list[Sequence]:
    """The sequence in a folder, or those in the folders inside it, in natural order.

    Raises
    ------
    VideoError
        Where there is none, or a truth that cannot be read.
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
    name = folder.resolve().name
    rects = sorted(folder.glob("groundtruth_rect*.txt"), key=natural_order)
    # One of OTB's own, of two objects, is empty.
    rects = [file for file in rects if file.stat().st_size] or rects
    if rects:
        ends = [file.stem.removeprefix("groundtruth_rect") if len(rects) > 1 else "" for file in rects]
        return [_sequence(name + end, folder, file, _rectangles) for file, end in zip(rects, ends, strict=True)]
    for file, reader in (
        (folder / "gt.txt", _corners),
        (folder / "groundtruth.txt", _polygons),
        (folder / f"{name}.txt", _rectangles),
    ):
        if file.is_file():
            return [_sequence(name, folder, file, reader)]
    return []


def _sequence(name: str, folder: Path, file: Path, reader: Callable[[np.ndarray], np.ndarray]) -> Sequence:
    boxes = reader(_numbers(file))
    boxes[~(np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1))] = np.nan
    if np.isnan(boxes).all():
        raise VideoError(f"{str(file)!r} has no box at all: the object must be somewhere")
    return Sequence(name, folder, boxes, _FIRST_FRAMES.get((name.lower(), len(boxes)), 0))


def _numbers(file: Path) -> np.ndarray:
    """The table in a text file, float64 (lines, columns), four columns at least."""
    rows: list[list[float]] = []
    try:
        lines = file.read_text(encoding="utf-8-sig").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise VideoError(f"{str(file)!r} cannot be read ({error}): expected a text file, a line a frame") from None
    for number, line in enumerate(lines, start=1):
        fields = line.replace(",", " ").replace(";", " ").split()
        if not fields:  # to pass it over would move all boxes after it by a frame
            raise VideoError(f"{str(file)!r}, line {number} is blank: where the object is absent write nan,nan,nan,nan")
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
        raise VideoError(f"{str(file)!r} is empty: expected a line a frame")
    return np.array(rows)


def _rectangles(table: np.ndarray) -> np.ndarray:
    return table[:, :4].copy()


def _corners(table: np.ndarray) -> np.ndarray:
    return np.hstack([table[:, :2], table[:, 2:4] - table[:, :2]])


def _polygons(table: np.ndarray) -> np.ndarray:
    if table.shape[1] < 6:
        return _rectangles(table)
    low, high = (np.stack([pick(table[:, axis::2], axis=1) for axis in (0, 1)], axis=1) for pick in (np.min, np.max))
    return np.hstack([low, high - low])
