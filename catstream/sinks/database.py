"""The table `tracks` of an SQLite database, which is read while a run adds to it, and its columns."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.destinations import About, Head, Origin, TrackedFrame

#: Column -> its type in SQLite. `seconds` is the time since the start of the source, `pts` the time stamp in a live
#: stream; a box is in pixels, and NULL if the object is absent; `object` is '' for an object without a name.
COLUMNS = {
    **{"frame": "INTEGER NOT NULL", "seq": "INTEGER NOT NULL", "seconds": "REAL NOT NULL", "state": "TEXT NOT NULL"},
    **{"x": "REAL", "y": "REAL", "w": "REAL", "h": "REAL", "score": "REAL NOT NULL"},
    **{"model_version": "INTEGER NOT NULL", "pts": "REAL", "object": "TEXT NOT NULL"},
    **{"began": "INTEGER NOT NULL", "doubtful": "INTEGER NOT NULL", "source_frame": "INTEGER NOT NULL"},
}
_NAMES = ", ".join(COLUMNS)
_TYPES = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
_CREATE = f"CREATE TABLE IF NOT EXISTS tracks ({_TYPES}, PRIMARY KEY (frame, object)) STRICT"
_INSERT = f"INSERT OR REPLACE INTO tracks ({_NAMES}) VALUES ({', '.join('?' for _ in COLUMNS)})"


class SqliteSink:
    """A table with the tracks of each frame at once; what was written remains, however this process ends.

    An existing file is replaced; if the run is resumed, the frames after `origin.last` are deleted. `last` is the
    number of the last frame in it, -1 for none.
    """

    def __init__(self, place: str, origin: Origin) -> None:
        self._place = place
        if origin.last < 0:
            for part in ("", "-wal", "-shm"):
                Path(f"{place}{part}").unlink(missing_ok=True)
        with _errors(place), ExitStack() as stack:
            self._database = stack.enter_context(closing(sqlite3.connect(place)))
            self._database.execute("PRAGMA journal_mode = WAL")  # nobody who reads makes the run wait
            self._database.execute("PRAGMA synchronous = NORMAL")
            with self._database:
                create(self._database, origin.head)
                self._database.execute("DELETE FROM tracks WHERE frame > ?", (origin.last,))
            (self.last,) = self._database.execute("SELECT ifnull(max(frame), -1) FROM tracks").fetchone()
            stack.pop_all()

    def write(self, frame: TrackedFrame) -> None:
        """Add the rows of a frame, all or none."""
        with _errors(self._place), self._database:
            self._database.executemany(_INSERT, rows([frame]))

    def close(self) -> None:
        with _errors(self._place):
            self._database.close()


def create(database: sqlite3.Connection, head: Head) -> None:
    """Create the tables of a log that has none yet."""
    database.execute(_CREATE)
    if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'head'").fetchone():
        database.execute("CREATE TABLE head (json TEXT NOT NULL) STRICT")
        database.execute("INSERT INTO head VALUES (?)", (head.to_json(),))


def write_sqlite(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    path.unlink(missing_ok=True)  # left by a process that was killed
    with _errors(path), closing(sqlite3.connect(path)) as database, database:
        create(database, about.head)
        database.executemany(_INSERT, rows(frames))


def read_database(path: Path) -> Iterator[TrackedFrame]:
    """Yield the frames of a database that may grow meanwhile, in their order; none if there is no file or no table."""
    if not path.exists():
        return
    with _errors(path, "read"), closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master").fetchone():  # killed before it made the table
            return
        found = database.execute(f"SELECT {_NAMES} FROM tracks ORDER BY frame, rowid")  # nosec B608
        for _, each in groupby(map(_track, found), lambda track: track.frame):
            yield TrackedFrame([*each])


def read_database_head(path: Path) -> Head | None:
    """The head of the log in a database; None if it has none."""
    with _errors(path, "read"), closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'head'").fetchone():
            return None
        return Head.from_json(database.execute("SELECT json FROM head").fetchone()[0])


def rows(frames: Iterable[TrackedFrame]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the table, in the order of the frames."""
    for track in (track for frame in frames for track in frame.tracks):
        box = track.box or [None] * 4
        yield (
            *(track.frame, track.seq, track.time, track.state, *box, track.score),
            *(track.model_version, track.pts, track.object, track.began, int(track.doubtful), track.source_frame),
        )


def _track(row: tuple[Any, ...]) -> Track:
    frame, seq, seconds, state, x, y, w, h, score, version, pts, name, began, doubtful, source = row
    box = None if x is None else Box(x, y, w, h)
    return Track(seq, frame, seconds, state, box, score, version, pts, name, began, bool(doubtful), source)


@contextmanager
def _errors(place: str | Path, what: str = "write") -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise VideoError(f"cannot {what} {place}: {error}") from None
