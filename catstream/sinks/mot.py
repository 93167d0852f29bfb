"""MOT text, as the tools of MOTChallenge read results: `frame,id,x,y,w,h,conf,-1,-1,-1`.

Frames, ids and pixels count from 1 there. The first object that appears has the id 1, and a name keeps its id. A frame
without any object has no line, so the file does not say how many frames there were.
"""

from __future__ import annotations

from pathlib import Path

from catstream.messages.kinds import Track
from catstream.sinks.lines import LineSink

__all__ = ["MotSink"]


class MotSink(LineSink):
    """Boxes as MOT text."""

    def __init__(self, path: Path, keep: int | None = None) -> None:
        self._ids: dict[str, int] = {}
        super().__init__(path, keep)

    def line(self, track: Track) -> str | None:
        """Return the line of a track, None if the object is absent."""
        number = self._ids.setdefault(track.object, len(self._ids) + 1)
        if track.box is None:
            return None
        x, y, w, h = track.box
        return f"{track.frame + 1},{number},{x + 1:.2f},{y + 1:.2f},{w:.2f},{h:.2f},{track.score:.4f},-1,-1,-1"
