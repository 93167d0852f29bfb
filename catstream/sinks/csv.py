"""Comma-separated values: the rows of `NAME.csv`, which `catstream track --output` writes."""

from __future__ import annotations

from catstream.messages.kinds import Track
from catstream.sinks.lines import LineSink
from catstream.video.results import COLUMNS, format_row, parse_row

__all__ = ["CsvSink"]


class CsvSink(LineSink):
    """Tracks as rows of comma-separated values."""

    header = COLUMNS + "\n"

    def line(self, track: Track) -> str:
        """Return the row of a track."""
        return format_row(track)

    @classmethod
    def track(cls, line: str) -> Track:
        """Return the track of a row; `pts` is not in the file, and is None."""
        return parse_row(line)
