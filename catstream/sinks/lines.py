"""Sinks of text, a line a track."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from catstream.errors import VideoError
from catstream.messages import Track

__all__ = ["LineSink"]


class LineSink(ABC):
    """Writes lines, each as soon as it comes; a format says how a track reads in `line`, and in `track` the reverse.

    Parameters
    ----------
    keep : go on with the file, if it is there, after its tracks of frames before this one; None for a new file

    Raises
    ------
    OSError
        From the constructor, if a new file is there already, or the file cannot be written.
    """

    #: The first line, with its end.
    header = ""

    def __init__(self, path: Path, keep: int | None = None) -> None:
        self.path = path
        self.rows = 0
        self._file: IO[Any] = self._open(keep)

    @abstractmethod
    def line(self, track: Track) -> str | None:
        """The text for a track, None where the format has none for it."""

    @classmethod
    def track(cls, line: str) -> Track:
        """The track of a line; ValueError, KeyError or TypeError if it is none."""
        raise ValueError(line)

    @classmethod
    def tracks(cls, path: Path) -> Iterator[Track]:
        """The tracks in a file, up to the first that is not whole; none if there is no file."""
        for _, track in cls._lines(path):
            yield track

    def write(self, track: Track) -> None:
        """Add a track."""
        text = self.line(track)
        if text is None:
            return
        with self._to_disk():
            self._file.write(text + "\n")
        self.rows += 1

    def close(self) -> None:
        """Close the file."""
        with self._to_disk():  # where a line was not taken, it is tried once more
            self._file.close()

    def _open(self, keep: int | None) -> IO[Any]:
        kept: list[int] = []
        if keep is not None and self.path.exists():
            kept = [end for end, track in self._lines(self.path) if track.frame < keep]
            os.truncate(self.path, kept[-1] if kept else 0)
        self.rows = len(kept)
        file = self.path.open("x" if keep is None else "a", encoding="utf-8", buffering=1)
        if not kept:
            file.write(self.header)
        return file

    @classmethod
    def _lines(cls, path: Path) -> Iterator[tuple[int, Track]]:
        """Where each whole line ends, in bytes, and its track."""
        if not path.exists():
            return
        with path.open("rb") as file:
            end = len(file.readline()) if cls.header else 0
            for line in file:
                end += len(line)
                if not line.endswith(b"\n"):
                    return
                try:
                    yield end, cls.track(line.decode())
                except (KeyError, TypeError, ValueError):  # what a disk holds where nothing was written yet
                    return

    @contextmanager
    def _to_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise VideoError(f"cannot write to {self.path} any more: {error.strerror}") from None
