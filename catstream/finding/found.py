"""The results of a search: its log, from which it is continued, its tables, and its report in HTML."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from catstream.base.box import Box
from catstream.base.files import write_atomically, writing
from catstream.base.text import counted
from catstream.errors import ServiceError
from catstream.finding.files import File, Reading
from catstream.finding.find import Sighting, Step
from catstream.reports.page import COLOURS, Bar, clock, figure, legend, table, timeline, write_page
from catstream.video.drawing import Colours, outline
from catstream.video.frames import jpeg

_KIND = "catstream find 3"  # and the version of the lines
_GAP_SECONDS, _GAP_STEPS = 1.0, 2.5  # longest time between two sightings of an interval: the longer one of these
_PICTURE = 240  # side of a picture in pixels
_SURROUNDINGS = 1.7  # side of a picture, as a multiple of the longer side of the object's box
_PICTURES = 24  # of each object, at most
_TIMELINES = 200  # files with the most sightings, if there are more

_SIGHTING = ("file", "object", "frame", "seconds", "x", "y", "w", "h", "score", "image")
_INTERVAL = ("file", "object", "begin", "end", "begin_seconds", "end_seconds", "sightings", "best_frame", "best_score")


@dataclass(slots=True)
class Interval:
    """The sightings of one object that follow one another.

    first, last  first and last sighting
    best         the one with the highest score
    count        number of sightings
    picture      JPEG of the best one
    """

    first: Sighting
    last: Sighting
    best: Sighting
    count: int = 1
    picture: bytes = b""


@dataclass(slots=True)
class FileResult(Reading):
    """The result for one file so far, frame by frame.

    A sighting continues the interval of its object if that ended a short time ago, wherever in the frame it is: a model
    is of one object, so its intervals never overlap.

    file       path of the video, the image or the folder
    signature  of the file when it was searched, see `File.signature`
    gap        longest time between two sightings of an interval, in seconds
    position   last frame that was searched, None before the first one
    time       time of this frame in seconds
    complete   whether the file was searched to its end, or to its damage
    sightings  in the order of the frames
    intervals  of all objects, in the order of their first sighting
    """

    file: str
    signature: list[int]
    gap: float
    position: int | None = None
    time: float = 0.0
    complete: bool = False
    sightings: list[Sighting] = field(default_factory=list)
    intervals: list[Interval] = field(default_factory=list)

    def add(self, step: Step) -> None:
        self.position, self.time = step.frame.number, step.frame.time
        for sighting in step.sightings:
            self.sightings.append(sighting)
            interval = next((each for each in reversed(self.intervals) if each.first.object == sighting.object), None)
            if interval is None or sighting.time - interval.last.time > self.gap:
                interval = Interval(sighting, sighting, sighting)
                self.intervals.append(interval)
            else:
                interval.last, interval.count = sighting, interval.count + 1
                interval.best = max(interval.best, sighting, key=lambda each: each.score)
            if interval.best is sighting:
                interval.picture = _picture(step.frame.image, sighting.box)


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
            self._stream = path.open("ab")
            self._stream.truncate(good)  # the last line of a process that was killed may be incomplete
            if not good:
                self._write({"kind": _KIND, "search": search})

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def begin(self, file: File) -> FileResult:
        """The result of a file: the stored one if the file has not changed since, otherwise an empty one."""
        signature, path = file.signature, str(file.path)
        known = self.results.get(path)
        if known is None or known.signature != signature:
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
                f"cannot write {str(self.path)!r} ({error.strerror}): the results so far are kept, and the "
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
                f"{str(self.path)!r} is not the log of a search ({error}): give another folder, or --overwrite"
            ) from None
        if head["search"] != self.search:
            changed = ", ".join(name for name in self.search if head["search"].get(name) != self.search[name])
            raise ServiceError(
                f"{str(self.path.parent)!r} has the results of a search that differs in {changed or 'version'}: give "
                "another folder, or replace them with --overwrite"
            )
        return whole


def write_tables(folder: Path, results: Iterable[FileResult], search: dict[str, Any]) -> None:
    """Write sightings.csv, intervals.csv and found.json."""
    sightings: list[tuple[Any, ...]] = []
    spans: list[tuple[Any, ...]] = []
    files = []
    for result in results:
        seen = [_sighting_row(each) for each in result.sightings]
        own = [_interval_row(each) for each in result.intervals]
        sightings += seen
        spans += own
        files.append(
            {
                "file": result.file,
                "frames": result.frames,
                "searched_to": result.position,
                "complete": result.complete,
                "problems": result.problems,
                "intervals": [dict(zip(_INTERVAL[1:], row[1:], strict=True)) for row in own],
                "sightings": [dict(zip(_SIGHTING[1:], row[1:], strict=True)) for row in seen],
            }
        )
    with writing(folder):
        write_atomically(folder / "sightings.csv", _csv(_SIGHTING, sightings))
        write_atomically(folder / "intervals.csv", _csv(_INTERVAL, spans))
        write_atomically(
            folder / "found.json", json.dumps({"search": search, "files": files}, indent=1).encode() + b"\n"
        )


def _sighting_row(each: Sighting) -> tuple[Any, ...]:
    box = (round(value, 2) for value in each.box)
    return (each.file, each.object, each.frame, round(each.time, 3), *box, round(each.score, 4), each.image)


def _interval_row(each: Interval) -> tuple[Any, ...]:
    first, last, best = each.first, each.last, each.best
    frames = first.frame, last.frame, round(first.time, 3), round(last.time, 3)
    return (first.file, first.object, *frames, each.count, best.frame, round(best.score, 4))


def _csv(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows(rows)
    return text.getvalue().encode(errors="surrogateescape")  # the name of a file need not be UTF-8


def write_report(path: Path, objects: Sequence[str], results: Sequence[FileResult]) -> Path:
    """Write the report of a search: pictures of the best sightings, and timelines."""
    names = _short_names([result.file for result in results])
    found = [result for result in results if result.sightings]
    shown = sorted(found, key=lambda result: -len(result.sightings))[:_TIMELINES]
    palette = Colours()
    colours = {name: palette.of(name) for name in objects}
    by_object: dict[str, list[Interval]] = {name: [] for name in objects}
    for each in (interval for result in results for interval in result.intervals):
        by_object[each.first.object].append(each)
    empty = [names[result.file] for result in results if not result.sightings and result.position is not None]
    problems = [(escape(names[result.file]), escape(each)) for result in results for each in result.problems]
    body = [
        "<h1>Found objects</h1>",
        _about(objects, results),
        table(("object", "files", "intervals", "seen", "best"), [_summary(name, by_object[name]) for name in objects]),
        *(part for name in objects for part in _sheet(name, by_object[name], names)),
        *(["<h2>Timelines</h2>", legend(colours)] if found else []),
        *(_timeline(result, names[result.file], colours) for result in results if result in shown),
        f'<p class="about">{len(found) - len(shown)} more files with fewer sightings: see intervals.csv</p>'
        if len(found) > len(shown)
        else "",
        *(
            [
                f"<h2>Nothing found <small>{counted(len(empty), 'file')}</small></h2>",
                f'<p class="about file">{escape(", ".join(empty))}</p>',
            ]
            if empty
            else []
        ),
        *(["<h2>Problems</h2>", table(("file", "problem"), problems, texts=2)] if problems else []),
    ]
    return write_page(path, "found objects", body)


def _about(objects: Sequence[str], results: Sequence[FileResult]) -> str:
    complete = sum(result.complete for result in results)
    of = "" if complete == len(results) else f"{complete} of "
    return (
        f'<p class="about">{counted(len(objects), "object")} in {of}{counted(len(results), "file")}, '
        f"{clock(sum(result.time for result in results))} of video. "
        "Each picture is the best sighting of an interval.</p>"
    )


def _summary(name: str, own: list[Interval]) -> list[object]:
    seconds = sum(each.last.time - each.first.time for each in own)
    best = f"{max(each.best.score for each in own):.2f}" if own else "<small>-</small>"
    return [escape(name), len({each.first.file for each in own}), len(own), clock(seconds), best]


def _sheet(name: str, own: list[Interval], names: dict[str, str]) -> list[str]:
    """The contact sheet of an object."""
    best = sorted(own, key=lambda each: -each.best.score)[:_PICTURES]
    if not best:
        return []
    more = f" <small>{len(best)} of {len(own)} intervals</small>" if len(own) > len(best) else ""
    figures = [
        figure(each.picture, names[at.file], f"{at.image or clock(at.time)}, score {at.score:.2f}", at.file)
        for each in best
        for at in [each.best]
    ]
    return [f"<h2>{escape(name)}{more}</h2>", f'<div class="pictures">{"".join(figures)}</div>']


def _timeline(result: FileResult, name: str, colours: dict[str, str]) -> str:
    lanes: dict[str, list[Bar]] = {}
    for each in result.intervals:
        best = each.best
        text = (
            f"{best.object} {clock(each.first.time)} to {clock(each.last.time)}: "
            f"score {best.score:.2f} at {clock(best.time)}"
        )
        bar = Bar(each.first.time, each.last.time, text, min(1.0, max(0.35, best.score)))
        lanes.setdefault(best.object, []).append(bar)
    state = "" if result.complete else " <small>searched in part</small>"
    title = f'<p class="file" title="{escape(result.file)}">{escape(name)}{state}</p>'
    return title + timeline(result.time, {name: lanes[name] for name in colours if name in lanes}, colours)


def _short_names(files: list[str]) -> dict[str, str]:
    """Each path without the folder that all have in common."""
    if len(files) < 2:
        return {file: Path(file).name for file in files}
    paths = {file: Path(file).absolute() for file in files}
    common = os.path.commonpath([path.parent for path in paths.values()])
    return {file: str(path.relative_to(common)) for file, path in paths.items()}
