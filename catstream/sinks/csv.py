"""Comma-separated values: the rows of `NAME.csv`, which `catstream track --output` writes."""

from __future__ import annotations

from catstream.messages import Track
from catstream.sinks.lines import LineSink
from catstream.video.results import COLUMNS, format_row, parse_row

__all__ = ["CsvSink"]


class CsvSink(LineSink):
    """Tracks as a table."""

    header = COLUMNS + "\n"

    def line(self, track: Track) -> str:
        """The row of a track."""
        return format_row(track)

    @classmethod
    def track(cls, line: str) -> Track:
        """The track of a row, without the time stamp of a live stream."""
        return parse_row(line)
