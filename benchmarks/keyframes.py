"""Accuracy of annotation: boxes are drawn from the ground truth where `Annotation.next_frame` asks for them.

The first box is that of the first frame with the object. Where the annotation asks for a frame with whose box tracking
cannot start, for example one of a single pixel, the nearest other frame gets a box. A row is printed for each number of
boxes, with means over the sequences. A sequence is complete from the number of boxes on with which both the share of
right frames and its estimate are at least 0.95.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
from accuracy import accuracy_command, in_processes, videos
from sequences import frame_size
from table import Table, benchmark

from catstream.base.arrays import Bool, Float64
from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.errors import BoxError, VideoError
from catstream.measure.datasets import Sequence
from catstream.offline.annotation import Annotation
from catstream.offline.passes import box_of, iou, row_of

#: The measures of a row, with their headings.
MEASURES = {
    "success": "success",
    "checked": "checked",
    "precision": "of these right",
    "expected": "expected",
    "complete": "complete",
    "interpolation": "interpolation",
    "forward": "forwards only",
}

#: Expected share of right frames from which an annotation counts as complete.
COMPLETE = 0.95


@dataclass(frozen=True, slots=True)
class KeyframeRow:
    """The measures of a sequence after a number of boxes, or their means over sequences; shares from 0 to 1.

    A frame is right if the overlap with the ground truth is above 0.5, or no box is reported where it has none.

    name           of the sequence
    boxes          number of keyframes
    success        share of right frames
    checked        share of checked frames and keyframes
    precision      share of right ones among the checked frames, without keyframes; None if there are none
    expected       mean probability of the frames to be right
    complete       whether both `success` and `expected` are at least 0.95
    interpolation  success of linear interpolation between the same boxes
    forward        success if each stretch is tracked forwards only, from the same boxes
    """

    name: str
    boxes: int
    success: float
    checked: float
    precision: float | None
    expected: float
    complete: float
    interpolation: float
    forward: float


def figures(options: argparse.Namespace) -> Iterator[Table]:
    found = videos(options)
    tasks = [(sequence, options.boxes, Settings()) for sequence in sorted(found, key=len, reverse=True)]
    by_name = {}
    for rows in in_processes(annotated, tasks, 1 if options.quick else options.jobs):
        print(rows[0].name, file=sys.stderr)
        by_name[rows[0].name] = rows
    rows = [row for sequence in found for row in by_name[sequence.name]]
    means, complete = mean_by_boxes(rows), boxes_until_complete(rows)
    options.record = {
        "rows": [dataclasses.asdict(row) for row in rows],
        "mean": [dataclasses.asdict(row) for row in means],
        "complete": complete,
    }
    counts = [count for count in complete.values() if count is not None]
    note = f"{len(counts)} of {len(complete)} sequences complete"
    note += f", with {fmean(counts):.1f} boxes on average" if counts else ""
    shares = [(row.boxes, *(getattr(row, measure) for measure in MEASURES)) for row in means]
    yield Table("Annotation with boxes from the ground truth", ("boxes", *MEASURES.values()), shares, note)


def annotated(sequence: Sequence, most: int, settings: Settings) -> list[KeyframeRow]:
    """Annotate a sequence with 1, 2 ... `most` boxes; return a row for each number of boxes."""
    return [*_rows(sequence, most, settings)]


def mean_by_boxes(rows: list[KeyframeRow]) -> list[KeyframeRow]:
    """The means over the sequences for each number of boxes; a sequence without frames to check counts in none."""
    means = []
    for boxes in sorted({row.boxes for row in rows}):
        group = [dataclasses.asdict(row) for row in rows if row.boxes == boxes]
        measured = {field: [row[field] for row in group if row[field] is not None] for field in MEASURES}
        shares: dict[str, Any] = {field: fmean(values) if values else None for field, values in measured.items()}
        means.append(KeyframeRow("mean", boxes, **shares))
    return means


def boxes_until_complete(rows: list[KeyframeRow]) -> dict[str, int | None]:
    """The number of boxes of each sequence from which it is complete; None if it is not with any number."""
    first: dict[str, int | None] = {}
    for row in sorted(rows, key=lambda row: row.boxes):
        if first.setdefault(row.name, None) is None and row.complete:
            first[row.name] = row.boxes
    return first


def _rows(sequence: Sequence, most: int, settings: Settings) -> Generator[KeyframeRow]:
    truth, size = sequence.boxes, frame_size(sequence)
    usable = [frame for frame in range(len(truth)) if _is_usable(truth[frame], size)]
    first = next((frame for frame in usable if box_of(truth[frame]) is not None), None)
    if first is None:
        raise VideoError("tracking cannot start at any box of the ground truth: use another sequence")
    part = slice(sequence.begin, sequence.begin + len(sequence))
    drawn = {first: box_of(truth[first])}
    with Annotation(sequence.path, drawn, settings, part=part, jobs=1) as annotation:
        annotation.track()
        while True:
            yield _row(sequence, annotation)
            (keyframes,) = annotation.keyframes.values()
            following, free = annotation.next_frame(), [frame for frame in usable if frame not in keyframes]
            if following is None or not free or len(keyframes) >= most:
                break
            frame = min(free, key=lambda frame: abs(frame - following.frame))
            annotation.add(frame, box_of(truth[frame]))
        last = _row(sequence, annotation)
        for boxes in range(len(keyframes) + 1, most + 1):  # more boxes are not asked for
            yield dataclasses.replace(last, boxes=boxes)


def _row(sequence: Sequence, annotation: Annotation) -> KeyframeRow:
    ((name, tracks),) = annotation.tracks.items()
    keyframes = annotation.keyframes[name]
    right = _right(np.stack([row_of(track.box) for track in tracks]), sequence.boxes)
    states = np.array([track.checked for track in tracks])
    checked, success = states == "checked", float(right.mean())
    expected = fmean(track.probability or 0.0 for track in tracks)
    return KeyframeRow(
        name=sequence.name,
        boxes=len(keyframes),
        success=success,
        checked=float((states != "unchecked").mean()),
        precision=float(right[checked].mean()) if checked.any() else None,
        expected=expected,
        complete=float(success >= COMPLETE and expected >= COMPLETE),
        interpolation=float(_right(_interpolated(keyframes, len(right)), sequence.boxes).mean()),
        forward=float(_right(_forward(annotation, name), sequence.boxes).mean()),
    )


def _right(boxes: Float64, truth: Float64) -> Bool:
    return iou(boxes, truth) > 0.5


def _interpolated(keyframes: dict[int, Box | None], count: int) -> Float64:
    """Boxes between the keyframes, linear in all four numbers; before the first and after the last one, its box."""
    present = sorted(frame for frame, box in keyframes.items() if box is not None)
    drawn = np.array([keyframes[frame] for frame in present])
    boxes = np.column_stack([np.interp(np.arange(count), present, drawn[:, side]) for side in range(4)])
    boxes[[frame for frame, box in keyframes.items() if box is None]] = np.nan
    return boxes


def _forward(annotation: Annotation, name: str) -> Float64:
    """Boxes of the passes that run forwards from each keyframe, without a memory; before the first one, none."""
    boxes = np.full((len(annotation.frames), 4), np.nan)
    for one in annotation.passes(name):
        if one.is_forward and not one.with_memory:
            boxes[one.start + 1 : one.stop + 1] = one.boxes
    for frame, box in annotation.keyframes[name].items():
        boxes[frame] = row_of(box)
    return boxes


def _is_usable(row: Float64, size: tuple[int, int]) -> bool:
    """Return True if a person could draw this: a box that tracking can start with, or that the object is absent."""
    box = box_of(row)
    try:
        return box is None or bool(box.validated(*size))
    except BoxError:
        return False


if __name__ == "__main__":
    benchmark(figures, accuracy_command(__doc__), boxes=(8, "largest number of boxes of a sequence"))
