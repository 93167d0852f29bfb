"""A database of tracks, in write-ahead mode: others may read it while it grows, and a crash loses no whole row."""

from __future__ import annotations

import sqlite3
from contextlib import ExitStack, closing
from pathlib import Path

from catstream.errors import VideoError
from catstream.messages import Track

__all__ = ["SqliteSink"]

_TABLE = """
CREATE TABLE tracks (
    frame         INTEGER PRIMARY KEY,
    seq           INTEGER NOT NULL,
    seconds       REAL NOT NULL,  -- since the start of the source
    state         TEXT NOT NULL,  -- bootstrapping, present, absent
    x REAL, y REAL, w REAL, h REAL,  -- pixels; NULL where absent
    score         REAL NOT NULL,
    model_version INTEGER NOT NULL,
    pts           REAL  -- time stamp in a live stream
) STRICT
"""


class SqliteSink:
    """Tracks as rows of the table `tracks`, each committed by itself.

    Raises
    ------
    VideoError
        From the constructor, where the database cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with ExitStack() as stack:
                self._database = stack.enter_context(closing(sqlite3.connect(path, isolation_level=None)))
                self._database.execute("PRAGMA journal_mode = WAL")
                self._database.execute("PRAGMA synchronous = NORMAL")  # a crash of the machine may cost the last rows
                self._database.execute(_TABLE)
                stack.pop_all()
        except sqlite3.Error as error:
            raise VideoError(f"cannot make the database {path} ({error}): give a place that you may write to") from None

    def write(self, track: Track) -> None:
        """Add a track."""
        row = (
            *(track.frame, track.seq, track.time, track.state),
            *(track.box or [None] * 4),
            *(track.score, track.model_version, track.pts),
        )
        try:
            self._database.execute("INSERT INTO tracks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
        except sqlite3.Error as error:
            raise VideoError(f"cannot write to {self.path} any more: {error}") from None

    def close(self) -> None:
        """Fold the log into the database, which is then one file."""
        self._database.close()
