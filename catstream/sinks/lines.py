"""Text files with one line for each track."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from catstream.errors import VideoError
from catstream.messages.kinds import Track

__all__ = ["LineSink"]


class LineSink(ABC):
    """Base class of text formats: `line` formats a track, and `track` parses a line. Each frame is written at once.

    Parameters
    ----------
    keep : continue an existing file after its tracks of the frames before this one; None for a new file

    Raises
    ------
    OSError
        From the constructor, if a new file exists already, or the file cannot be written.
    """

    #: The first line of a file, with its line end.
    header = ""

    def __init__(self, path: Path, keep: int | None = None) -> None:
        self.path = path
        self.rows = 0
        self._file: IO[str] = self._open(keep)

    @abstractmethod
    def line(self, track: Track) -> str | None:
        """Return the line of a track, without its line end; None if the format has no line for it."""

    @classmethod
    def track(cls, line: str) -> Track:
        """Return the track of a line; raise ValueError, KeyError or TypeError if it is none."""
        raise ValueError(line)

    @classmethod
    def tracks(cls, path: Path) -> Iterator[Track]:
        """Yield the tracks of a file up to the first incomplete line; none if the file does not exist."""
        for _, track in cls._lines(path):
            yield track

    def write(self, tracks: Sequence[Track]) -> None:
        """Add the tracks of a frame, in one write."""
        lines: list[str] = []
        for track in tracks:
            if (line := self.line(track)) is not None:
                lines.append(line + "\n")
                self.rows += 1
        if lines:
            with self._translated_errors():
                self._file.write("".join(lines))

    def close(self) -> None:
        """Close the file."""
        with self._translated_errors():  # a line that the disk did not take is tried again
            self._file.close()

    def _open(self, keep: int | None) -> IO[str]:
        kept: list[int] = []
        if keep is not None and self.path.exists():
            kept = [end for end, track in self._lines(self.path) if track.frame < keep]
            os.truncate(self.path, kept[-1] if kept else 0)
        self.rows = len(kept)
        with ExitStack() as stack:  # a file whose header the disk does not take is closed, and removed if it is new
            file = self.path.open("x" if keep is None else "a", encoding="utf-8", buffering=1)
            if keep is None:
                stack.callback(self.path.unlink)
            stack.enter_context(file)
            if not kept:
                file.write(self.header)
            stack.pop_all()
        return file

    @classmethod
    def _lines(cls, path: Path) -> Iterator[tuple[int, Track]]:
        """Yield the end of each complete line, in bytes from the start, and its track."""
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
                except (KeyError, TypeError, ValueError):  # a power cut can leave zeros at the end
                    return

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise VideoError(f"cannot write to {self.path} any more: {error.strerror}") from None
