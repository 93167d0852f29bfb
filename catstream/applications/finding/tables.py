"""The results of a search as CSV and JSON files."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from catstream.applications.finding.sightings import FileResult, Interval, Sighting
from catstream.messages import storage

_SIGHTING = ("file", "object", "frame", "seconds", "x", "y", "w", "h", "score", "image")
_INTERVAL = ("file", "object", "begin", "end", "begin_seconds", "end_seconds", "sightings", "best_frame", "best_score")


def write_tables(folder: Path, results: Iterable[FileResult], search: dict[str, Any]) -> None:
    """Write sightings.csv, intervals.csv and found.json.

    Raises
    ------
    ServiceError
        If a file cannot be written.
    """
    results = list(results)
    sightings = [_sighting_row(each) for result in results for each in result.sightings]
    intervals = [_interval_row(each) for result in results for each in result.intervals]
    found = {"search": search, "files": [_file(result) for result in results]}
    with storage.writing(folder):
        storage.write_atomically(folder / "sightings.csv", _csv(_SIGHTING, sightings))
        storage.write_atomically(folder / "intervals.csv", _csv(_INTERVAL, intervals))
        storage.write_atomically(folder / "found.json", json.dumps(found, indent=1).encode() + b"\n")


def _file(result: FileResult) -> dict[str, Any]:
    return {
        "file": result.file,
        "frames": result.frames,
        "searched_to": result.position,
        "complete": result.complete,
        "problems": result.problems,
        "intervals": [dict(zip(_INTERVAL[1:], _interval_row(each)[1:], strict=True)) for each in result.intervals],
        "sightings": [dict(zip(_SIGHTING[1:], _sighting_row(each)[1:], strict=True)) for each in result.sightings],
    }


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
