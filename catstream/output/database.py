"""The table `tracks` of an SQLite database, which may be read while a run writes it."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

from catstream.base.box import Box
from catstream.base.files import REMEDIES, open_locked
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.output.destinations import Header, Origin, Sink, TrackedFrame
from catstream.output.remote import CLOSE_SECONDS, Warnings
from catstream.wire.messages import Track

#: SQLite types by column. `seconds` is the time since the start of the source, `pts` the time stamp in a live stream. A
#: box is in pixels, and NULL if the object is absent; `object` is '' for an object without a name. Except in an
#: annotation, `checked` is '' and `probability` NULL.
COLUMNS = {
    **{"frame": "INTEGER NOT NULL", "seconds": "REAL NOT NULL", "state": "TEXT NOT NULL"},
    **{"x": "REAL", "y": "REAL", "w": "REAL", "h": "REAL", "score": "REAL NOT NULL"},
    **{"model_version": "INTEGER NOT NULL", "pts": "REAL", "object": "TEXT NOT NULL"},
    **{"began": "INTEGER NOT NULL", "doubtful": "INTEGER NOT NULL", "source_frame": "INTEGER NOT NULL"},
    **{"checked": "TEXT NOT NULL", "probability": "REAL"},
}
_NAMES = ", ".join(COLUMNS)
_TYPES = ", ".join(f"{name} {kind}" for name, kind in COLUMNS.items())
_CREATE = f"CREATE TABLE IF NOT EXISTS tracks ({_TYPES}, PRIMARY KEY (frame, object)) STRICT"
_INSERT = f"INSERT OR REPLACE INTO tracks ({_NAMES}) VALUES ({', '.join('?' for _ in COLUMNS)})"

#: Maximum number of frames that wait for a locked database.
_MOST_WAITING = 1 << 16

#: Errors of the system by errors of SQLite.
_ERRNO = {sqlite3.SQLITE_FULL: errno.ENOSPC, sqlite3.SQLITE_READONLY: errno.EROFS, sqlite3.SQLITE_IOERR: errno.EIO}


class _LockedError(VideoError):
    """Another program has locked the database."""


class SqliteSink(Sink):
    """Writes each frame in one transaction; written rows survive a crash of this process.

    An existing file is replaced, unless it is a log that is continued. While another program locks the database, up to
    `_MOST_WAITING` frames wait in memory; the oldest are dropped. If the file is removed or renamed, a warning is
    logged, and a new file continues.
    """

    def __init__(self, dest: str, origin: Origin) -> None:
        self._dest, self._header, self._warnings = dest, origin.header, Warnings(dest)
        self._waiting: deque[TrackedFrame] = deque()
        self.missed = 0
        self._database: sqlite3.Connection | None = None
        self._lock = open_locked(Path(dest), VideoError, None)
        if origin.last is None:
            for part in ("", "-wal", "-shm"):
                Path(f"{dest}{part}").unlink(missing_ok=True)
            self._lock.close()
            self._lock = open_locked(Path(dest), VideoError)
        try:
            self._flush()
        except VideoError:
            self._lock.close()
            raise

    def write(self, frame: TrackedFrame) -> None:
        """Add the rows of a frame after the waiting frames, in one transaction."""
        self._waiting.append(frame)
        if len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()
            self.missed += 1
        self._flush()

    def close(self) -> None:
        """Close the database; VideoError if it is still locked after some seconds."""
        try:
            self._flush(CLOSE_SECONDS)
            if lost := len(self._waiting) + self.missed:
                raise VideoError(
                    f"{self._dest} lacks {counted(lost, 'frame')}, because another program locked it: if the run has "
                    "an NDJSON log, catstream export makes it again"
                )
        finally:
            with _errors(self._dest), self._lock:
                if self._database is not None:
                    self._database.close()

    def _flush(self, seconds: float = 0.0) -> None:
        """Write the waiting frames; if the database is locked, retry for some seconds."""
        try:
            with _errors(self._dest):
                self._follow()
                self._database = self._database or self._connect()
                self._database.execute(f"PRAGMA busy_timeout = {1000 * seconds:.0f}")
                with self._database:
                    self._database.executemany(_INSERT, rows(self._waiting))
        except _LockedError:
            self._warnings.failed("locked by another program; frames wait in memory")
            return
        except VideoError:
            self._waiting.clear()
            raise
        self._waiting.clear()
        self._warnings.working()

    def _connect(self) -> sqlite3.Connection:
        with ExitStack() as stack:
            database = stack.enter_context(closing(sqlite3.connect(self._dest, timeout=0)))
            database.execute("PRAGMA journal_mode = WAL")  # readers do not block the run
            database.execute("PRAGMA synchronous = NORMAL")
            with database:
                create(database, self._header)
            stack.pop_all()
        return database

    def _follow(self) -> None:
        """Open a new file if another program has removed or renamed the old one."""
        path = Path(self._dest)
        if path.exists() and os.path.samestat(path.stat(), os.fstat(self._lock.fileno())):
            return
        self._warnings.log("removed or renamed by another program; the log continues without the earlier rows")
        if self._database is not None:
            self._database.close()
        self._database = None
        self._lock.close()
        self._lock = open_locked(path, VideoError, None)


def create(database: sqlite3.Connection, header: Header) -> None:
    """Create the tables of a log, unless they exist."""
    database.execute(_CREATE)
    if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'header'").fetchone():
        database.execute("CREATE TABLE header (json TEXT NOT NULL) STRICT")
        database.execute("INSERT INTO header VALUES (?)", (header.to_json(),))


def write_database(frames: Iterable[TrackedFrame], path: Path, header: Header) -> None:
    """Write all frames to a new database."""
    with _errors(path), closing(sqlite3.connect(path)) as database, database:
        create(database, header)
        database.executemany(_INSERT, rows(frames))


def read_database(path: Path) -> Iterator[TrackedFrame]:
    """Yield the frames of a database, which may be growing, in order; nothing without a file or table."""
    if not path.exists():
        return
    with _errors(path, "read"), closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master").fetchone():  # killed before it created the table
            return
        rows = database.execute(f"SELECT {_NAMES} FROM tracks ORDER BY frame, rowid")  # nosec B608
        for _, tracks in groupby(map(_track, rows), lambda track: track.frame):
            yield TrackedFrame([*tracks])


def read_database_header(path: Path) -> Header | None:
    """The header of the log in a database; None without one."""
    with _errors(path, "read"), closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'header'").fetchone():
            return None
        return Header.from_json(database.execute("SELECT json FROM header").fetchone()[0])


def rows(frames: Iterable[TrackedFrame]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the table, in the order of the frames."""
    for track in (track for frame in frames for track in frame.tracks):
        box = track.box or [None] * 4
        yield (
            *(track.frame, track.time, track.state, *box, track.score),
            *(track.model_version, track.pts, track.object, track.began, int(track.doubtful), track.source_frame),
            *(track.checked, track.probability),
        )


def _track(row: tuple[Any, ...]) -> Track:
    frame, seconds, state, x, y, w, h, score, version, pts, name, began, doubtful, *rest = row
    box = None if x is None else Box(x, y, w, h)
    return Track(frame, seconds, state, box, score, version, pts, name, began, bool(doubtful), *rest)


@contextmanager
def _errors(dest: str | Path, what: str = "write") -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        if error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED) and what == "write":
            raise _LockedError(f"{dest} is locked by another program: close it there") from None
        remedy = REMEDIES.get(_ERRNO.get(error.sqlite_errorcode & 0xFF, 0), "check the file")
        raise VideoError(f"cannot {what} {str(dest)!r} ({error}): {remedy}") from None
