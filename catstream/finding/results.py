"""The results of a search: its log, from which it is continued, its tables, and its report in HTML."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from catstream.base.box import Box
from catstream.base.files import open_locked, write_atomically, writing
from catstream.base.text import counted
from catstream.errors import ServiceError
from catstream.finding.files import File, Reading
from catstream.finding.find import Detection, Step
from catstream.reports.report import COLOURS, clock, write_page
from catstream.video.drawing import Colours, outline
from catstream.video.frames import jpeg

_KIND = "catstream find 4"  # and the version of the lines
_GAP_SECONDS, _GAP_STEPS = 1.0, 2.5  # longest time between two detections of an interval: the longer one of these
_PICTURE = 240  # side of a picture in pixels
_SURROUNDINGS = 1.7  # side of a picture, as a multiple of the longer side of the object's box
_PICTURES = 24  # of each object, at most
_TIMELINES = 200  # files with the most detections, if there are more

_DETECTION = ("file", "object", "frame", "seconds", "x", "y", "w", "h", "score", "image")
_INTERVAL = ("file", "object", "begin", "end", "begin_seconds", "end_seconds", "detections", "best_frame", "best_score")


@dataclass(slots=True)
class Interval:
    """Consecutive detections of one object.

    first, last  first and last detection
    best         detection with the highest score
    count        number of detections
    picture      JPEG of the best detection
    """

    first: Detection
    last: Detection
    best: Detection
    count: int = 1
    picture: bytes = b""


@dataclass(slots=True)
class FileResult(Reading):
    """The result for one file so far, frame by frame.

    A detection continues the interval of its object if that ended a short time ago, wherever in the frame it is: a
    model is of one object, so its intervals never overlap.

    file       path of the video, the image or the folder
    signature  of the file when it was searched, see `File.signature`
    gap        longest time between two detections of an interval, in seconds
    position   last frame that was searched, None before the first one
    time       time of this frame in seconds
    complete   whether the file was searched to its end, or to its damage
    detections  in the order of the frames
    intervals  of all objects, in the order of their first detection
    """

    file: str
    signature: list[int]
    gap: float
    position: int | None = None
    time: float = 0.0
    complete: bool = False
    detections: list[Detection] = field(default_factory=list)
    intervals: list[Interval] = field(default_factory=list)

    def add(self, step: Step) -> None:
        self.position, self.time = step.frame.number, step.frame.time
        for detection in step.detections:
            self.detections.append(detection)
            own = (interval for interval in reversed(self.intervals) if interval.first.object == detection.object)
            interval = next(own, None)
            if interval is None or detection.time - interval.last.time > self.gap:
                interval = Interval(detection, detection, detection)
                self.intervals.append(interval)
            else:
                interval.last, interval.count = detection, interval.count + 1
                interval.best = max(interval.best, detection, key=lambda at: at.score)
            if interval.best is detection:
                interval.picture = _picture(step.frame.image, detection.box)


def _picture(image: np.ndarray, box: Box) -> bytes:
    """A small square JPEG of an object with its box and some of its surroundings."""
    height, width = image.shape[:2]
    side = round(np.clip(max(box.w, box.h) * _SURROUNDINGS, 16, min(width, height)))
    left, top = (round(centre - side / 2) for centre in box.centre)
    left, top = int(np.clip(left, 0, width - side)), int(np.clip(top, 0, height - side))
    picture = image[top : top + side, left : left + side].copy()
    outline(picture, Box(box.x - left, box.y - top, box.w, box.h), COLOURS[0], unit=side / _PICTURE)
    return jpeg(picture, _PICTURE)


class SearchLog(AbstractContextManager["SearchLog"]):
    """The results of all files; those that were searched to the end are lines of a JSON file. Use it in a `with`.

    path       of the file; it is continued if it exists
    search     models and options; a file of another search is not continued
    overwrite  start again from nothing
    """

    def __init__(self, path: Path, search: Mapping[str, Any], *, overwrite: bool = False) -> None:
        self.path, self.search = path, search
        self.results: dict[str, FileResult] = {}
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            good = 0 if overwrite or not path.exists() else self._load(path.read_bytes())
            # The last line of a process that was killed may be incomplete.
            self._stream = open_locked(path, size=good, mode="ab")
            if not good:
                self._write({"kind": _KIND, "search": search})

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def begin(self, file: File) -> FileResult:
        """The result of a file: the stored one if the file has not changed since, otherwise an empty one."""
        signature, path = file.signature, str(file.path)
        stored = self.results.get(path)
        if stored is None or stored.signature != signature:
            gap = max(_GAP_SECONDS, _GAP_STEPS * self.search["every"])
            self.results[path] = FileResult(path, signature, gap)
        return self.results[path]

    def end(self, result: FileResult) -> None:
        """Store the result of a file that was searched to its end."""
        result.complete = True
        self._write(msgspec.to_builtins(result))

    def _write(self, line: Mapping[str, Any]) -> None:
        try:
            self._stream.write(json.dumps(line, separators=(",", ":")).encode() + b"\n")
            self._stream.flush()
        except OSError as error:
            raise ServiceError(
                f"cannot write {str(self.path)!r} ({error.strerror}): the results so far are saved, and the "
                "same command continues"
            ) from None

    def _load(self, data: bytes) -> int:
        """Read the complete lines of a file; returns their length in bytes."""
        whole = data.rfind(b"\n") + 1
        lines = data[:whole].splitlines()
        if not lines:
            return 0
        try:
            head, *rest = map(json.loads, lines)
            if head["kind"] != _KIND:
                raise ValueError(f"it is of kind {head['kind']!r}, not {_KIND!r}")
            if head["search"] == self.search:
                self.results = {line["file"]: msgspec.convert(line, FileResult) for line in rest}
        except (AttributeError, KeyError, TypeError, ValueError, msgspec.MsgspecError) as error:
            raise ServiceError(
                f"{str(self.path)!r} is not the log of a search ({error}): pass another folder, or --overwrite"
            ) from None
        if head["search"] != self.search:
            changed = ", ".join(name for name in self.search if head["search"].get(name) != self.search[name])
            raise ServiceError(
                f"{str(self.path.parent)!r} has the results of a search that differs in {changed or 'version'}: pass "
                "another folder, or replace them with --overwrite"
            )
        return whole


def write_tables(folder: Path, results: Iterable[FileResult], search: dict[str, Any]) -> None:
    """Write detections.csv, intervals.csv and results.json."""
    detections: list[tuple[Any, ...]] = []
    intervals: list[tuple[Any, ...]] = []
    files = []
    for result in results:
        own_detections = [_detection_row(detection) for detection in result.detections]
        own_intervals = [_interval_row(interval) for interval in result.intervals]
        detections += own_detections
        intervals += own_intervals
        files.append(
            {
                "file": result.file,
                "frames": result.frames,
                "searched_to": result.position,
                "complete": result.complete,
                "problems": result.problems,
                "intervals": [dict(zip(_INTERVAL[1:], row[1:], strict=True)) for row in own_intervals],
                "detections": [dict(zip(_DETECTION[1:], row[1:], strict=True)) for row in own_detections],
            }
        )
    with writing(folder):
        write_atomically(folder / "detections.csv", _csv(_DETECTION, detections))
        write_atomically(folder / "intervals.csv", _csv(_INTERVAL, intervals))
        write_atomically(
            folder / "results.json", json.dumps({"search": search, "files": files}, indent=1).encode() + b"\n"
        )


def _detection_row(at: Detection) -> tuple[Any, ...]:
    box = (round(value, 2) for value in at.box)
    return (at.file, at.object, at.frame, round(at.time, 3), *box, round(at.score, 4), at.image)


def _interval_row(interval: Interval) -> tuple[Any, ...]:
    first, last, best = interval.first, interval.last, interval.best
    frames = first.frame, last.frame, round(first.time, 3), round(last.time, 3)
    return (first.file, first.object, *frames, interval.count, best.frame, round(best.score, 4))


def _csv(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows(rows)
    return text.getvalue().encode(errors="surrogateescape")  # the name of a file need not be UTF-8


class _Bar(NamedTuple):
    """An interval in a timeline: its place and width in percent, its opacity, and the text of its tooltip."""

    left: float
    width: float
    opacity: float
    text: str


class _Timeline(NamedTuple):
    """The timeline of a file: the bars of each object."""

    file: str
    complete: bool
    time: float
    lanes: dict[str, list[_Bar]]


def write_report(path: Path, objects: Sequence[str], results: Sequence[FileResult]) -> Path:
    """Write the report of a search: pictures of the best detections, and timelines."""
    names = _short_names([result.file for result in results])
    hits = [result for result in results if result.detections]
    longest = sorted(hits, key=lambda result: -len(result.detections))[:_TIMELINES]
    palette, complete = Colours(), sum(result.complete for result in results)
    by_object: dict[str, list[Interval]] = {name: [] for name in objects}
    for interval in (interval for result in results for interval in result.intervals):
        by_object[interval.first.object].append(interval)
    return write_page(
        path,
        "finding.html",
        about=f"{counted(len(objects), 'object')} in {f'{complete} of ' * (complete < len(results))}"
        f"{counted(len(results), 'file')}, {clock(sum(result.time for result in results))} of video.",
        summary=[_summary(name, intervals) for name, intervals in by_object.items()],
        objects={name: sorted(of, key=lambda interval: -interval.best.score) for name, of in by_object.items()},
        most_pictures=_PICTURES,
        colours={name: palette.of(name) for name in objects},
        timelines=[_timeline(result) for result in results if result in longest],
        more_files=len(hits) - len(longest),
        empty=[names[result.file] for result in results if not result.detections and result.position is not None],
        files=len(results),
        problems=[(names[result.file], problem) for result in results for problem in result.problems],
        names=names,
    )


def _summary(name: str, intervals: list[Interval]) -> list[object]:
    seconds = sum(interval.last.time - interval.first.time for interval in intervals)
    best = f"{max(interval.best.score for interval in intervals):.2f}" if intervals else "-"
    return [name, len({interval.first.file for interval in intervals}), len(intervals), clock(seconds), best]


def _timeline(result: FileResult) -> _Timeline:
    lanes: dict[str, list[_Bar]] = {}
    percent = 100 / max(result.time, 1e-3)
    for interval in result.intervals:
        first, last, best = interval.first.time, interval.last.time, interval.best
        text = f"{best.object} {clock(first)} to {clock(last)}: score {best.score:.2f} at {clock(best.time)}"
        bar = _Bar(percent * first, percent * (last - first), min(1.0, max(0.35, best.score)), text)
        lanes.setdefault(best.object, []).append(bar)
    return _Timeline(result.file, result.complete, result.time, lanes)


def _short_names(files: list[str]) -> dict[str, str]:
    """Each path without the folder that all have in common."""
    if len(files) < 2:
        return {file: Path(file).name for file in files}
    paths = {file: Path(file).absolute() for file in files}
    common = os.path.commonpath([path.parent for path in paths.values()])
    return {file: str(path.relative_to(common)) for file, path in paths.items()}
