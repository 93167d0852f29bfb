"""MOT text, as the tools of MOTChallenge read results: `frame,id,x,y,w,h,conf,-1,-1,-1`.

Frames and pixels count from 1 there, from 0 in catstream. The object has the id 1. A frame without the object has no
line, so the file does not say how many frames there were.
"""

from __future__ import annotations

from catstream.messages import Track
from catstream.sinks.lines import LineSink

__all__ = ["MotSink"]


class MotSink(LineSink):
    """Boxes as MOT text."""

    def line(self, track: Track) -> str | None:
        """Return the line of a track, None if the object is absent."""
        if track.box is None:
            return None
        x, y, w, h = track.box
        return f"{track.frame + 1},1,{x + 1:.2f},{y + 1:.2f},{w:.2f},{h:.2f},{track.score:.4f},-1,-1,-1"
