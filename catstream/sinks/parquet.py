"""Tracks in a column store, from their database: pyarrow, pandas, DuckDB and Spark read it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from catstream.errors import VideoError
from catstream.extras import need

__all__ = ["export"]

_ROWS = 65536  # in memory at once


def export(database: Path, path: Path) -> int:
    """Write the tracks of a database to a Parquet file, which gets its name when it is whole.

    Returns
    -------
    how many rows it has

    Raises
    ------
    VideoError
        If the database cannot be read or the file cannot be written.
    MissingExtraError
        If pyarrow is not installed.
    """
    need("parquet")
    import pyarrow as arrow
    import pyarrow.parquet

    kinds = {"INTEGER": arrow.int64(), "REAL": arrow.float64(), "TEXT": arrow.string()}
    part, rows = path.with_name(path.name + ".part"), 0
    try:
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=rw", uri=True)) as tracks:
            names = tracks.execute("SELECT name, type FROM pragma_table_info('tracks')").fetchall()
            schema = arrow.schema([(name, kinds[kind]) for name, kind in names])
            cursor = tracks.execute("SELECT * FROM tracks ORDER BY frame")
            with arrow.parquet.ParquetWriter(part, schema) as writer:
                while batch := cursor.fetchmany(_ROWS):
                    columns = zip(zip(*batch, strict=True), schema.types, strict=True)
                    writer.write_batch(arrow.record_batch([arrow.array(*column) for column in columns], schema=schema))
                    rows += len(batch)
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise VideoError(f"cannot write {path} from {database}: {error}") from None
    finally:
        part.unlink(missing_ok=True)
    return rows
