"""Text files with one line for each track, or for each frame."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

from catstream.errors import VideoError
from catstream.messages.kinds import Track


class LineFile:
    """A text file that grows by whole lines. What was added remains, however this process ends.

    Parameters
    ----------
    header : the first line, with its line end; may be empty
    again : whether an existing file is written again. It stays as it is until `publish`; the lines are in NAME.part

    Raises
    ------
    OSError
        From the constructor, if the file cannot be written.
    """

    def __init__(self, path: Path, header: str = "", *, again: bool = False) -> None:
        self.path = path
        self._part = path.with_name(f"{path.name}.part") if again else None
        self._file: IO[str]
        with ExitStack() as stack:  # a file for whose header the disk has no room is closed and removed
            self._file = self._open()
            stack.callback(self._remove)
            stack.enter_context(self._file)
            self._file.write(header)
            stack.pop_all()

    def add(self, text: str) -> None:
        """Add whole lines, in one write."""
        with self._translated_errors():
            self._file.write(text)

    def publish(self) -> None:
        """Take the place of the file that is written again."""
        if self._part is not None:
            with self._translated_errors():
                os.fsync(self._file.fileno())  # the lines must be on disk before the new name
                self._part.replace(self.path)
            self._part = None

    def close(self) -> None:
        """Close the file; one that was to be written again stays as it was if it was not published."""
        with self._translated_errors():  # a line for which the disk had no room is tried again
            try:
                self._file.close()
            finally:
                if self._part is not None:
                    self._remove()

    def _open(self) -> IO[str]:
        return (self._part or self.path).open("w", encoding="utf-8", buffering=1)

    def _remove(self) -> None:
        (self._part or self.path).unlink(missing_ok=True)

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise VideoError(f"cannot write to {self.path} any more: {error.strerror}") from None


class LineSink(LineFile, ABC):
    """Base class of the formats with a line for each track: `line` formats a track, and `track` parses a line."""

    #: The first line of a file, with its line end.
    header = ""

    def __init__(self, path: Path, *, again: bool = False) -> None:
        super().__init__(path, self.header, again=again)

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
        with suppress(FileNotFoundError), path.open("rb") as file:
            if cls.header:
                file.readline()
            for line in file:
                try:
                    track = cls.track(line.decode())
                except (KeyError, TypeError, ValueError):  # a power cut can leave zeros at the end
                    return
                if not line.endswith(b"\n"):
                    return
                yield track

    def write(self, tracks: Sequence[Track]) -> None:
        """Add the tracks of a frame."""
        lines = [line for track in tracks if (line := self.line(track)) is not None]
        if lines:
            self.add("\n".join(lines) + "\n")
