"""Newline-delimited JSON: an object a line, with the fields of `Track`; a box is [x, y, w, h] or null."""

from __future__ import annotations

import json
from dataclasses import asdict

from catstream.messages import Track
from catstream.sinks.lines import LineSink

__all__ = ["NdjsonSink"]


class NdjsonSink(LineSink):
    """Tracks as JSON."""

    def line(self, track: Track) -> str:
        """The fields of a track."""
        return json.dumps(asdict(track))
