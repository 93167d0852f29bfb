"""Formats that are made at the end of a run, from the NDJSON file to which it has written its tracks.

tracks.json      one array of the JSON objects
tracks.sqlite    the table `tracks` of a database
tracks.parquet   the same table in a column store, which pyarrow, pandas, DuckDB and Spark read
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

from catstream.errors import VideoError
from catstream.sinks.formats import NdjsonSink

#: Column -> its type in SQLite. `seconds` is the time since the start of the source, `pts` the time stamp in a live
#: stream; a box is in pixels, and NULL if the object is absent; `object` is '' for an object without a name.
_COLUMNS = {
    **{"frame": "INTEGER NOT NULL", "seq": "INTEGER NOT NULL", "seconds": "REAL NOT NULL", "state": "TEXT NOT NULL"},
    **{"x": "REAL", "y": "REAL", "w": "REAL", "h": "REAL", "score": "REAL NOT NULL"},
    **{"model_version": "INTEGER NOT NULL", "pts": "REAL", "object": "TEXT NOT NULL"},
}
_BATCH = 65536  # rows in memory at once


def make(path: Path, source: Path) -> None:
    """Make a file from an NDJSON file; it gets its name once it is complete.

    Raises
    ------
    VideoError
        If it cannot be written. The NDJSON file remains.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        part.unlink(missing_ok=True)  # left by a process that was killed
        MADE[path.suffix](source, part)
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise VideoError(f"cannot write {path} ({error}): its tracks are in {source}") from None
    finally:
        part.unlink(missing_ok=True)


def _json(source: Path, path: Path) -> None:
    with source.open() as lines, path.open("w") as file:
        file.write("[")
        for number, line in enumerate(lines):
            file.write(("," if number else "") + line)
        file.write("]\n")


def _sqlite(source: Path, path: Path) -> None:
    columns = ", ".join(f"{name} {kind}" for name, kind in _COLUMNS.items())
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(f"CREATE TABLE tracks ({columns}, PRIMARY KEY (frame, object)) STRICT")
        database.executemany("INSERT INTO tracks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", _rows(source))


def _parquet(source: Path, path: Path) -> None:
    import pyarrow as arrow
    import pyarrow.parquet

    kinds = {"INTEGER": arrow.int64(), "REAL": arrow.float64(), "TEXT": arrow.string()}
    schema = arrow.schema([(name, kinds[kind.split()[0]]) for name, kind in _COLUMNS.items()])
    rows = _rows(source)
    with arrow.parquet.ParquetWriter(path, schema) as writer:
        while batch := [*islice(rows, _BATCH)]:
            columns = zip(zip(*batch, strict=True), schema.types, strict=True)
            writer.write_batch(arrow.record_batch([arrow.array(*column) for column in columns], schema=schema))


def _rows(source: Path) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the table, in the order of the file."""
    for track in NdjsonSink.tracks(source):
        box = track.box or [None] * 4
        yield (
            *(track.frame, track.seq, track.time, track.state, *box, track.score),
            *(track.model_version, track.pts, track.object),
        )


#: Suffix -> the function that makes a file of this format: `function(source, path)`.
MADE: dict[str, Callable[[Path, Path], None]] = {".json": _json, ".sqlite": _sqlite, ".parquet": _parquet}
