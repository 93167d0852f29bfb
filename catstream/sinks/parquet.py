"""Parquet, a column store that pyarrow, pandas, DuckDB and Spark read.

A Parquet file cannot be extended. Until the sink is closed, its tracks are rows of an SQLite database beside the file,
`tracks.parquet.sqlite`, which remains if the process is killed or the disk is full.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from catstream.errors import VideoError, require_extra
from catstream.messages.kinds import Track
from catstream.sinks.frames import by_frame
from catstream.sinks.sqlite import SqliteSink, track_of

__all__ = ["ParquetSink", "database_of"]

_ROWS = 65536  # in memory at once


class ParquetSink:
    """Tracks as rows of a Parquet file, which is written when this is closed.

    Parameters
    ----------
    keep : continue an existing file after its tracks of the frames before this one; None for a new file

    Raises
    ------
    VideoError
        From the constructor, if the folder cannot be written to.
    MissingExtraError
        From the constructor, if pyarrow is not installed.
    """

    def __init__(self, path: Path, keep: int | None = None) -> None:
        require_extra("parquet")
        self.path, self._database = path, database_of(path)
        closed = path.exists() and not self._database.exists()
        self._rows = SqliteSink(self._database, keep)
        if keep is not None and closed:
            for tracks in by_frame(_read(path)):
                if tracks[0].frame < keep:
                    self._rows.write(tracks)

    @classmethod
    def tracks(cls, path: Path) -> Iterator[Track]:
        """Yield the tracks of a file, or of the database beside it if it was not closed; none if neither exists."""
        if database_of(path).exists():
            yield from SqliteSink.tracks(database_of(path))
        elif path.exists():
            yield from _read(path)

    def write(self, tracks: Sequence[Track]) -> None:
        """Add the tracks of a frame."""
        self._rows.write(tracks)

    def close(self) -> None:
        """Write the file, which gets its name once it is complete, and remove the database."""
        self._rows.close()
        _export(self._database, self.path)
        self._database.unlink()


def database_of(path: Path) -> Path:
    """Return the path of the database that holds the tracks of a Parquet file until it is closed."""
    return path.with_name(path.name + ".sqlite")


def _read(path: Path) -> Iterator[Track]:
    require_extra("parquet")
    from pyarrow.parquet import ParquetFile

    try:
        for batch in ParquetFile(path).iter_batches(_ROWS):
            for row in batch.to_pylist():
                yield track_of(tuple(row.values()))
    except (OSError, ValueError) as error:
        raise VideoError(f"cannot read {path} ({error}): is it a Parquet file of tracks?") from None


def _export(database: Path, path: Path) -> None:
    import pyarrow as arrow
    import pyarrow.parquet

    kinds = {"INTEGER": arrow.int64(), "REAL": arrow.float64(), "TEXT": arrow.string()}
    part = path.with_name(path.name + ".part")
    try:
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=rw", uri=True)) as tracks:
            names = tracks.execute("SELECT name, type FROM pragma_table_info('tracks')").fetchall()
            schema = arrow.schema([(name, kinds[kind]) for name, kind in names])
            cursor = tracks.execute("SELECT * FROM tracks ORDER BY frame, rowid")
            with arrow.parquet.ParquetWriter(part, schema) as writer:
                while batch := cursor.fetchmany(_ROWS):
                    columns = zip(zip(*batch, strict=True), schema.types, strict=True)
                    writer.write_batch(arrow.record_batch([arrow.array(*column) for column in columns], schema=schema))
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise VideoError(f"cannot write {path} ({error}): its tracks stay in {database}") from None
    finally:
        part.unlink(missing_ok=True)
