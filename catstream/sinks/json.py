"""JSON: a track is an object, as `Track.to_dict` gives it; a box is [x, y, w, h] or null.

One object on each line (NDJSON), in a file or on standard output; or one array of all objects, which is complete once
it is closed.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.lines import LineSink

__all__ = ["JsonSink", "NdjsonSink", "StdoutSink"]


class NdjsonSink(LineSink):
    """Tracks as JSON objects, one on each line."""

    def line(self, track: Track) -> str:
        """Return the fields of a track as a JSON object."""
        return json.dumps(track.to_dict())

    @classmethod
    def track(cls, line: str) -> Track:
        """Return the track of a JSON object."""
        fields = json.loads(line)
        return Track(**{**fields, "box": fields["box"] and Box(*fields["box"])})


class JsonSink(NdjsonSink):
    """Tracks as one JSON array, one on each line; `close` writes the closing bracket."""

    def line(self, track: Track) -> str:
        """Return the JSON object after the bracket or comma that precedes it in the array."""
        return ("," if self.rows else "[") + super().line(track)

    @classmethod
    def track(cls, line: str) -> Track:
        """Return the track of a line: the object after its first character."""
        return super().track(line[1:])

    def close(self) -> None:
        """Write the closing bracket and close the file."""
        try:
            with self._translated_errors():
                self._file.write("]\n" if self.rows else "[]\n")
        finally:
            super().close()


class StdoutSink(NdjsonSink):
    """Tracks as JSON objects, one on each line, on standard output."""

    def close(self) -> None:
        """Do nothing: standard output belongs to the process."""

    def _open(self, _: int | None) -> IO[str]:
        return sys.stdout

    def write(self, tracks: Sequence[Track]) -> None:
        """Write the tracks of a frame and flush them."""
        super().write(tracks)
        with self._translated_errors():
            self._file.flush()

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # The interpreter flushes standard output again when it exits: that must not fail a second time.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._file.fileno())
            if isinstance(error, BrokenPipeError):  # its reader wants no more, as `head` does: no error of ours
                raise
            raise VideoError(f"cannot write to standard output any more: {error.strerror}") from None
