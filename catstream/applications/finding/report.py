"""Writes the report of a search as one self-contained HTML file: timelines, and the best sightings as pictures."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from catstream.applications.finding.sightings import FileResult, Interval
from catstream.applications.html.page import figure, table, write_page
from catstream.applications.html.timeline import Bar, clock, legend, timeline
from catstream.messages.names import counted
from catstream.video.annotate import Colours

_PICTURES = 24  # of each object, at most
_TIMELINES = 200  # files with the most sightings, if there are more


def write_report(path: Path, objects: Sequence[str], results: Iterable[FileResult]) -> Path:
    """Write the report of a search.

    Raises
    ------
    ServiceError
        If the file cannot be written.
    """
    results = list(results)
    names = _short_names([result.file for result in results])
    found = [result for result in results if result.intervals]
    shown = sorted(found, key=lambda result: -len(result.sightings))[:_TIMELINES]
    palette = Colours()
    colours = {name: palette.of(name) for name in objects}
    body = [
        "<h1>Found objects</h1>",
        _about(objects, results),
        _summary(objects, results),
        *(part for name in objects for part in _sheet(name, results, names)),
        "<h2>Timelines</h2>" if found else "",
        legend(colours) if found else "",
        *(_timeline(result, objects, names, colours) for result in results if result in shown),
        f'<p class="about">{len(found) - len(shown)} more files with fewer sightings: see intervals.csv</p>'
        if len(found) > len(shown)
        else "",
        *_empty(results, names),
        *_problems(results, names),
    ]
    return write_page(path, "found objects", body)


def _about(objects: Sequence[str], results: list[FileResult]) -> str:
    complete = sum(result.complete for result in results)
    of = "" if complete == len(results) else f"{complete} of "
    return (
        f'<p class="about">{counted(len(objects), "object")} in {of}{counted(len(results), "file")}, '
        f"{clock(sum(result.time for result in results))} of video. "
        "Each picture is the best sighting of an interval.</p>"
    )


def _summary(objects: Sequence[str], results: list[FileResult]) -> str:
    rows = []
    for name in objects:
        intervals = [each for result in results for each in result.intervals if each.first.object == name]
        seconds = sum(each.last.time - each.first.time for each in intervals)
        best = max((each.best.score for each in intervals), default=None)
        files = len({each.first.file for each in intervals})
        shown = "<small>-</small>" if best is None else f"{best:.2f}"
        rows.append([escape(name), files, len(intervals), clock(seconds), shown])
    return table(("object", "files", "intervals", "seen", "best"), rows)


def _sheet(name: str, results: list[FileResult], names: dict[str, str]) -> list[str]:
    """The contact sheet of an object."""
    intervals = [each for result in results for each in result.intervals if each.first.object == name]
    best = sorted(intervals, key=lambda each: -each.best.score)[:_PICTURES]
    if not best:
        return []
    more = f" <small>{len(best)} of {len(intervals)} intervals</small>" if len(intervals) > len(best) else ""
    figures = "\n".join(_figure(each, names) for each in best)
    return [f"<h2>{escape(name)}{more}</h2>", f'<div class="pictures">{figures}</div>']


def _figure(interval: Interval, names: dict[str, str]) -> str:
    best = interval.best
    caption = f"{best.image or clock(best.time)}, score {best.score:.2f}"
    return figure(interval.picture, names[best.file], caption, best.file)


def _timeline(result: FileResult, objects: Sequence[str], names: dict[str, str], colours: dict[str, str]) -> str:
    lanes: dict[str, list[Bar]] = {}
    for name in objects:
        bars = [_bar(each) for each in result.intervals if each.first.object == name]
        if bars:
            lanes[name] = bars
    state = "" if result.complete else " <small>searched in part</small>"
    title = f'<p class="file" title="{escape(result.file)}">{escape(names[result.file])}{state}</p>'
    return title + timeline(result.time, lanes, colours)


def _bar(interval: Interval) -> Bar:
    best = interval.best
    text = (
        f"{best.object} {clock(interval.first.time)} to {clock(interval.last.time)}: "
        f"score {best.score:.2f} at {clock(best.time)}"
    )
    return Bar(interval.first.time, interval.last.time, text, min(1.0, max(0.35, best.score)))


def _empty(results: list[FileResult], names: dict[str, str]) -> list[str]:
    """The files in which nothing was found."""
    empty = [names[result.file] for result in results if not result.intervals and result.position is not None]
    if not empty:
        return []
    return [
        f"<h2>Nothing found <small>{counted(len(empty), 'file')}</small></h2>",
        f'<p class="about file">{escape(", ".join(empty))}</p>',
    ]


def _problems(results: list[FileResult], names: dict[str, str]) -> list[str]:
    rows = [(escape(names[result.file]), escape(problem)) for result in results for problem in result.problems]
    return ["<h2>Problems</h2>", table(("file", "problem"), rows, texts=2)] if rows else []


def _short_names(files: list[str]) -> dict[str, str]:
    """Each path without the folder that all have in common."""
    if len(files) < 2:
        return {file: Path(file).name for file in files}
    paths = {file: Path(file).absolute() for file in files}
    common = os.path.commonpath([path.parent for path in paths.values()])
    return {file: str(path.relative_to(common)) for file, path in paths.items()}
