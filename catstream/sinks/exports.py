"""Formats that are made from a log: text files of the benchmarks' toolkits, and a column store."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from catstream.base.arrays import Float64
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.database import COLUMNS, rows
from catstream.sinks.destinations import About, Origin, TrackedFrame
from catstream.sinks.track_log import CsvSink

#: Layout -> the files of boxes, scores and times of an object, in the folder of the results; NAME is that of the log,
#: or NAME-OBJECT. The toolkits of got10k (which has OTB, too) and VOT read them.
LAYOUTS = {
    "otb": ("{0}.txt", "{0}_confidence.value", "times/{0}_time.txt"),
    "got10k": ("{0}/{0}_001.txt", "{0}/{0}_confidence.value", "{0}/{0}_time.txt"),
    "vot": ("{0}/{0}_001.txt", "{0}/{0}_001_confidence.value", "{0}/{0}_001_time.value"),
}

_BATCH = 65536  # rows in memory at once


def write_layout(
    layout: str, folder: Path, name: str, boxes: Float64, confidence: Float64 | None, seconds: Float64 | None
) -> None:
    """Write the files of one object in one of the `LAYOUTS`; raises OSError if that is not possible.

    boxes : float64 (frames, 4), x, y, w, h in pixels; NaN if there is none
    confidence, seconds : score and processing time, float64 (frames,); None to write no such file
    """
    values = (boxes, confidence, seconds)
    for pattern, column, form in zip(LAYOUTS[layout], values, ("%.4f", "%.6f", "%.8f"), strict=True):
        if column is not None:
            file = folder / pattern.format(name)
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(file, column, fmt=form, delimiter=",")


def write_mot(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write boxes as the tools of MOTChallenge read results: `frame,id,x,y,w,h,conf,-1,-1,-1`.

    Frames of the source, ids and pixels count from 1 there. The first object that appears has the id 1; another object
    that was given the same name has another one. A frame without any object has no line, so the file does not say how
    many frames there were.
    """
    ids: dict[tuple[str, int], int] = {}
    with path.open("w", encoding="utf-8") as file:
        for track in (track for frame in frames for track in frame.tracks):
            number = ids.setdefault((track.object, track.began), len(ids) + 1)
            if track.box is not None:
                x, y, w, h = track.box
                box = f"{x + 1:.2f},{y + 1:.2f},{w:.2f},{h:.2f}"
                file.write(f"{track.source_frame + 1},{number},{box},{track.score:.4f},-1,-1,-1\n")


def write_dlc(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write the centres of the boxes in the layout of DeepLabCut, with a row for each frame of the source.

    Objects are its individuals, and the score is its likelihood. A single object without a name is written as of a
    project with a single animal, which has no line of individuals.
    """
    tables = _tables(frames, lambda name: name or "object")
    heads = {"scorer": ["catstream"] * len(tables), "individuals": [*tables], "bodyparts": ["centre"] * len(tables)}
    if [*tables] == ["object"]:
        del heads["individuals"]
    lines = [",".join([head, *np.repeat(words, 3)]) for head, words in heads.items()]
    lines.append("coords" + ",x,y,likelihood" * len(tables))
    columns = [np.column_stack([table[:, :2] + table[:, 2:4] / 2, table[:, 4]]) for table in tables.values()]
    rows = np.column_stack([np.arange(len(columns[0])), *columns])
    form = ["%d"] + ["%.6f"] * (rows.shape[1] - 1)
    np.savetxt(path, rows, form, ",", header="\n".join(lines), comments="", encoding="utf-8")


def write_sleap(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write the centres of the boxes as SLEAP's analysis CSV, a row for each box, which sleap-io converts to `.slp`."""
    with path.open("w", encoding="utf-8") as file:
        file.write("track,frame_idx,instance.score,centre.x,centre.y,centre.score\n")
        for name, track, _seconds in _named(frames, lambda name: name or "object"):
            if track.box is not None:
                x, y = track.box.centre
                score = f"{track.score:.6f}"
                file.write(f"{name},{track.source_frame},{score},{x:.6f},{y:.6f},{score}\n")


def write_csv(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write the CSV file of a run, which tables and pandas read."""
    with closing(CsvSink(str(path), Origin())) as sink:
        for frame in frames:
            sink.write(frame)


def write_parquet(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write the columns of the table `tracks` of a database, which pyarrow, pandas, DuckDB and Spark read."""
    import pyarrow as arrow
    import pyarrow.parquet

    kinds = {"INTEGER": arrow.int64(), "REAL": arrow.float64(), "TEXT": arrow.string()}
    schema = arrow.schema([(name, kinds[kind.split()[0]]) for name, kind in COLUMNS.items()])
    cells = rows(frames)
    with arrow.parquet.ParquetWriter(path, schema) as writer:
        while batch := [*islice(cells, _BATCH)]:
            columns = zip(zip(*batch, strict=True), schema.types, strict=True)
            writer.write_batch(arrow.record_batch([arrow.array(*column) for column in columns], schema=schema))


def _write_objects(layout: str, frames: Iterable[TrackedFrame], folder: Path, about: About) -> None:
    """Write the files of each object, with a row for each frame of the source up to the last one of the log.

    Those of times are written only if the log has them, as a CSV file has. Another object that was given the same name
    has files of its own. If `about.append`, VideoError if a file exists.
    """
    tables = _tables(frames, lambda name: f"{about.name}-{name}" if name else about.name)
    files = [folder / pattern.format(name) for name in tables for pattern in LAYOUTS[layout]]
    if about.append and (existing := [file for file in files if file.exists()]):
        raise VideoError(f"{existing[0]} exists already: replace it with --overwrite, or use another folder")
    for name, table in tables.items():
        seconds = None if np.isnan(table[:, 5]).all() else table[:, 5]
        write_layout(layout, folder, name, table[:, :4], table[:, 4], seconds)


def _tables(frames: Iterable[TrackedFrame], name_of: Callable[[str], str]) -> dict[str, Float64]:
    """The table of each object by its name, as of `_named`.

    A table is float64 (frames, 6), x, y, w, h, score and processing time, with a row for each frame of the source up to
    the last one of the log; NaN if there is none.
    """
    rows: dict[str, dict[int, tuple[float, ...]]] = {}
    times: dict[int, float] = {}
    for name, track, seconds in _named(frames, name_of):
        rows.setdefault(name, {})[track.source_frame] = (*(track.box or [np.nan] * 4), track.score)
        times[track.source_frame] = seconds
    tables: dict[str, Float64] = {}
    for name, of_object in rows.items():
        tables[name] = np.full((max(times) + 1, 6), np.nan)
        tables[name][list(of_object), :5] = list(of_object.values())
        tables[name][list(times), 5] = list(times.values())
    return tables


def _named(frames: Iterable[TrackedFrame], name_of: Callable[[str], str]) -> Iterator[tuple[str, Track, float]]:
    """Yield the name of each object, its track, and the processing time of the frame.

    The name is `name_of` that of the object, with @FRAME if another object had the same before.
    """
    names: dict[tuple[str, int], str] = {}
    for frame in frames:
        for track in frame.tracks:
            key = track.object, track.began
            if key not in names:
                name = name_of(track.object)
                names[key] = f"{name}@{track.source_frame}" if name in names.values() else name
            yield names[key], track, frame.seconds


write_otb = partial(_write_objects, "otb")
write_got10k = partial(_write_objects, "got10k")
write_vot = partial(_write_objects, "vot")
