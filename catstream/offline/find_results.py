"""The results of a search: a line for each searched file, tables, and a page with a picture of each interval."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from catstream.base.box import Box
from catstream.base.files import open_locked, writing
from catstream.base.tables import write_table
from catstream.errors import ServiceError
from catstream.offline.find import Detection
from catstream.offline.find_files import File
from catstream.output.report import COLOURS, write_page
from catstream.video.drawing import outline
from catstream.video.frames import Frame, jpeg

_GAP_SECONDS, _GAP_STEPS = 1.0, 2.5  # maximum time between two detections of an interval: the longer of these
_PICTURE = 240  # side of a picture in pixels
_SURROUNDINGS = 1.7  # side of a picture, as a multiple of the longer side of the object's box
_PICTURES = 200  # maximum number of pictures of each object


@dataclass(slots=True)
class Interval:
    """Consecutive detections of one object in a file, the best detection, and its JPEG."""

    detections: list[Detection]
    best: Detection
    picture: bytes = b""

    @property
    def times(self) -> tuple[float, float]:
        """Times of the first and the last detection in seconds."""
        return self.detections[0].time, self.detections[-1].time


@dataclass(slots=True)
class FileResult:
    """The result for one file.

    file       path of the video, the image or the folder
    search     digest of the models and options: see `Search.digest`
    pages      number of its images, 0 for a video
    gap        maximum time between two detections of an interval, in seconds
    problems   errors of damaged or missing parts
    intervals  intervals of all objects, in the order of their first detection
    """

    file: str
    search: str
    pages: int
    gap: float
    problems: list[str] = field(default_factory=list)
    intervals: list[Interval] = field(default_factory=list)

    @classmethod
    def of(cls, file: File, search: str, every: float) -> FileResult:
        return cls(str(file.path), search, len(file.pages), max(_GAP_SECONDS, _GAP_STEPS * every))

    def add(self, frame: Frame, detections: Iterable[Detection]) -> None:
        """Add the detections in a frame.

        A detection continues the interval of its object after a short gap, at any position in the frame: a model is of
        one object, so its intervals never overlap.
        """
        for detection in detections:
            own = (interval for interval in reversed(self.intervals) if interval.best.object == detection.object)
            interval = next(own, None)
            if interval is None or detection.time - interval.times[1] > self.gap:
                interval = Interval([], detection)
                self.intervals.append(interval)
            interval.detections.append(detection)
            interval.best = max(interval.best, detection, key=lambda at: at.score)
            if interval.best is detection:
                interval.picture = _picture(frame.image, detection.box)


def _picture(image: np.ndarray, box: Box) -> bytes:
    """A small square JPEG of an object with its box and its surroundings."""
    height, width = image.shape[:2]
    side = round(np.clip(max(box.w, box.h) * _SURROUNDINGS, 16, min(width, height)))
    left, top = (round(centre - side / 2) for centre in box.centre)
    left, top = int(np.clip(left, 0, width - side)), int(np.clip(top, 0, height - side))
    picture = image[top : top + side, left : left + side].copy()
    outline(picture, Box(box.x - left, box.y - top, box.w, box.h), COLOURS[0], unit=side / _PICTURE)
    return jpeg(picture, _PICTURE)


class SearchResults(AbstractContextManager["SearchResults"]):
    """The results in a folder: results.ndjson has a line for each searched file. Use it in a `with`.

    files  results by the path of the file
    """

    def __init__(self, folder: Path, search: str, *, overwrite: bool = False) -> None:
        self._path = folder / "results.ndjson"
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            data = b"" if overwrite or not self._path.exists() else self._path.read_bytes()
        whole = data.rfind(b"\n") + 1  # a killed process may have left an incomplete last line
        try:
            rows = [msgspec.convert(json.loads(line), FileResult) for line in data[:whole].splitlines()]
        except (ValueError, msgspec.MsgspecError) as error:
            raise ServiceError(
                f"{str(self._path)!r} has no results of a search ({error}): pass another folder, or --overwrite"
            ) from None
        if any(row.search != search for row in rows):
            raise ServiceError(
                f"{str(folder)!r} has the results of other models or options: pass another folder, or --overwrite"
            )
        self.files = {row.file: row for row in rows}
        self._stream = open_locked(self._path, size=whole, mode="ab")

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def has(self, file: File) -> bool:
        """Return True if a file was searched, and the number of images in a folder is unchanged."""
        result = self.files.get(str(file.path))
        return result is not None and result.pages == len(file.pages)

    def add(self, result: FileResult) -> None:
        """Store the result of a completely searched or damaged file."""
        self.files[result.file] = result
        with writing(self._path):
            self._stream.write(json.dumps(msgspec.to_builtins(result), separators=(",", ":")).encode() + b"\n")
            self._stream.flush()


def write_detections(path: Path, intervals: Iterable[Interval]) -> None:
    """Write a CSV file with a row for each detection."""
    columns = ("file", "object", "frame", "seconds", "x", "y", "w", "h", "score", "image")
    rows = (
        (
            at.file,
            at.object,
            at.frame,
            round(at.time, 3),
            *(round(side, 2) for side in at.box),
            round(at.score, 4),
            at.image,
        )
        for interval in intervals
        for at in interval.detections
    )
    write_table(path, columns, rows)


def write_report(path: Path, objects: Iterable[str], results: Sequence[FileResult], intervals: list[Interval]) -> Path:
    """Write the page of a search, with the intervals of each object in order."""
    by_object: dict[str, list[Interval]] = {name: [] for name in objects}
    for interval in intervals:
        by_object[interval.best.object].append(interval)
    problems = [problem for result in results for problem in result.problems]
    return write_page(path, "finding.html", files=len(results), objects=by_object, most=_PICTURES, problems=problems)
