"""An SQLite database of tracks in write-ahead mode: others may read it meanwhile, and a crash loses no whole row."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track

__all__ = ["SqliteSink", "track_of"]

_TABLE = """
CREATE TABLE IF NOT EXISTS tracks (
    frame         INTEGER NOT NULL,
    seq           INTEGER NOT NULL,
    seconds       REAL NOT NULL,  -- since the start of the source
    state         TEXT NOT NULL,  -- bootstrapping, present, absent
    x REAL, y REAL, w REAL, h REAL,  -- pixels; NULL if absent
    score         REAL NOT NULL,
    model_version INTEGER NOT NULL,
    pts           REAL,  -- time stamp in a live stream
    object        TEXT NOT NULL,  -- '' if it has no name
    PRIMARY KEY (frame, object)
) STRICT
"""


class SqliteSink:
    """Tracks as rows of the table `tracks`; those of a frame are one transaction.

    Parameters
    ----------
    keep : continue an existing file after its tracks of the frames before this one; None for a new file

    Raises
    ------
    VideoError
        From the constructor, if the database cannot be created.
    """

    def __init__(self, path: Path, keep: int | None = None) -> None:
        self.path = path
        try:
            with ExitStack() as stack:
                self._database = stack.enter_context(closing(sqlite3.connect(path, isolation_level=None)))
                self._database.execute("PRAGMA journal_mode = WAL")
                self._database.execute("PRAGMA synchronous = NORMAL")  # a power cut may lose the last rows
                self._database.execute(_TABLE)
                if keep is not None:
                    self._database.execute("DELETE FROM tracks WHERE frame >= ?", (keep,))
                stack.pop_all()
        except sqlite3.Error as error:
            raise VideoError(
                f"cannot create the database {path} ({error}): give a path that you may write to"
            ) from None

    @classmethod
    def tracks(cls, path: Path) -> Iterator[Track]:
        """Yield the tracks of a database in the order in which they were written; none if the file does not exist.

        Raises
        ------
        VideoError
            If it cannot be read.
        """
        if not path.exists():
            return
        try:
            with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True)) as database:
                for row in database.execute("SELECT * FROM tracks ORDER BY frame, rowid"):
                    yield track_of(row)
        except sqlite3.Error as error:
            raise VideoError(f"cannot read {path} ({error}): is it a database of tracks?") from None

    def write(self, tracks: Sequence[Track]) -> None:
        """Add the tracks of a frame."""
        rows = [
            (
                *(track.frame, track.seq, track.time, track.state),
                *(track.box or [None] * 4),
                *(track.score, track.model_version, track.pts, track.object),
            )
            for track in tracks
        ]
        try:
            self._database.execute("BEGIN")
            self._database.executemany("INSERT INTO tracks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
            self._database.execute("COMMIT")
        except sqlite3.Error as error:
            raise VideoError(f"cannot write to {self.path} any more: {error}") from None

    def close(self) -> None:
        """Merge the write-ahead log into the database, which is then one file."""
        self._database.close()


def track_of(row: tuple[Any, ...]) -> Track:
    """Return the track of a row of the table."""
    frame, seq, seconds, state, x, y, w, h, score, version, pts, name = row
    return Track(seq, frame, seconds, state, None if x is None else Box(x, y, w, h), score, version, pts, name)
