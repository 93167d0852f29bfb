"""Newline-delimited JSON: an object a line, as `Track.to_dict` gives it; a box is [x, y, w, h] or null."""

from __future__ import annotations

import json

from catstream.messages import Track
from catstream.sinks.lines import LineSink

__all__ = ["NdjsonSink"]


class NdjsonSink(LineSink):
    """Tracks as JSON."""

    def line(self, track: Track) -> str:
        """The fields of a track."""
        return json.dumps(track.to_dict())
