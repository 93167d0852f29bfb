"""MOT text, as the tools of MOTChallenge read results: `frame,id,x,y,w,h,conf,-1,-1,-1`.

Frames and pixels count from 1 there, so each is one more than here. The one object is number 1; a frame
without it has no line, so that a file does not tell how many frames there were.
"""

from __future__ import annotations

from catstream.messages import Track
from catstream.sinks.lines import LineSink

__all__ = ["MotSink"]


class MotSink(LineSink):
    """Boxes as MOT text."""

    def line(self, track: Track) -> str | None:
        """The line of a track, None where the object is absent."""
        if track.box is None:
            return None
        x, y, w, h = track.box
        return f"{track.frame + 1},1,{x + 1:.2f},{y + 1:.2f},{w:.2f},{h:.2f},{track.score:.4f},-1,-1,-1"
