"""Comma-separated values: the rows of `tracks.csv`, which `catstream track` writes."""

from __future__ import annotations

from catstream.messages import Track
from catstream.sinks.lines import LineSink
from catstream.video.results import COLUMNS, row

__all__ = ["CsvSink"]


class CsvSink(LineSink):
    """Tracks as a table."""

    header = COLUMNS + "\n"

    def line(self, track: Track) -> str:
        """The row of a track."""
        return row(track)
