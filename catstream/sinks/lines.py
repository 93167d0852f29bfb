"""Sinks of text, a line a track."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from catstream.errors import VideoError
from catstream.messages import Track

__all__ = ["LineSink"]


class LineSink(ABC):
    """Writes lines, each as soon as it comes; a kind says how a track reads in `line`.

    Raises
    ------
    OSError
        From the constructor, where the file is there already or cannot be written.
    """

    #: The first line, with its end.
    header = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("x", encoding="utf-8", buffering=1)
        self._file.write(self.header)

    @abstractmethod
    def line(self, track: Track) -> str | None:
        """The text for a track, None where the format has none for it."""

    def write(self, track: Track) -> None:
        """Add a track."""
        text = self.line(track)
        if text is None:
            return
        with self._to_disk():
            self._file.write(text + "\n")

    def close(self) -> None:
        """Close the file."""
        with self._to_disk():  # where a line was not taken, it is tried once more
            self._file.close()

    @contextmanager
    def _to_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise VideoError(f"cannot write to {self.path} any more: {error.strerror}") from None
