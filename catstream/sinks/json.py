"""JSON: a track is an object, as `Track.to_dict` gives it; a box is [x, y, w, h] or null.

An object a line (NDJSON), in a file or on standard output; or one array of all objects, which ends when it is closed.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages import Track
from catstream.sinks.lines import LineSink

__all__ = ["JsonSink", "NdjsonSink", "StdoutSink"]


class NdjsonSink(LineSink):
    """Tracks as JSON, an object a line."""

    def line(self, track: Track) -> str:
        """The fields of a track."""
        return json.dumps(track.to_dict())

    @classmethod
    def track(cls, line: str) -> Track:
        """The track of an object."""
        fields = json.loads(line)
        return Track(**{**fields, "box": fields["box"] and Box(*fields["box"])})


class JsonSink(NdjsonSink):
    """Tracks as one JSON array, a line each; the bracket at its end comes when it is closed."""

    def line(self, track: Track) -> str:
        """The fields of a track, after the mark that goes before them in the array."""
        return ("," if self.rows else "[") + super().line(track)

    @classmethod
    def track(cls, line: str) -> Track:
        """The track of an object, without the mark before it."""
        return super().track(line[1:])

    def close(self) -> None:
        """End the array."""
        try:
            with self._to_disk():
                self._file.write("]\n" if self.rows else "[]\n")
        finally:
            super().close()


class StdoutSink(NdjsonSink):
    """Tracks as JSON, an object a line, on standard output."""

    def close(self) -> None:
        """Leave standard output open: it is not this object's."""

    def _open(self, _: int | None) -> IO[Any]:
        return sys.stdout

    def write(self, track: Track) -> None:
        """Add a track."""
        with self._to_disk():
            self._file.write(self.line(track) + "\n")
            self._file.flush()

    @contextmanager
    def _to_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # What the reader did not take is flushed once more when the program ends: it goes nowhere then.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._file.fileno())
            raise VideoError(f"cannot write to standard output any more: {error.strerror}") from None
