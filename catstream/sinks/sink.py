"""What a sink is, and which one a file's name asks for.

tracks.ndjson    an object a line, as on the wire
tracks.csv       a row a frame, as `catstream track` writes it
tracks.txt       MOT text, as the tools of MOTChallenge read it
tracks.sqlite    a table in a database that others may read meanwhile
walk.mp4         the video with the tracks drawn in
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from catstream.errors import VideoError
from catstream.messages import Track
from catstream.sinks.csv import CsvSink
from catstream.sinks.mot import MotSink
from catstream.sinks.ndjson import NdjsonSink
from catstream.sinks.sqlite import SqliteSink
from catstream.sinks.video import VideoSink
from catstream.video.source import WHOLE

__all__ = ["SUFFIXES", "Sink", "open_sink"]


class Sink(Protocol):
    """Takes tracks in order, each frame once. What `write` returned from outlives this process, but for a video."""

    def write(self, track: Track) -> None:
        """Add a track; raises VideoError where the file takes no more."""

    def close(self) -> None:
        """Make the file whole; what was written stays. Raises VideoError where the file takes no more."""


_KINDS: dict[str, Callable[[Path], Sink]] = {
    ".ndjson": NdjsonSink,
    ".csv": CsvSink,
    ".txt": MotSink,
    ".sqlite": SqliteSink,
}

#: What the name of a file may end with.
SUFFIXES = (*_KINDS, ".mp4")


def open_sink(path: Path, source: str | None = None, part: slice = WHOLE) -> Sink:
    """A new file for tracks, of the kind that its name says.

    Parameters
    ----------
    source, part : what the pipeline follows, as it was told; a video is read from it once more

    Raises
    ------
    VideoError
        Where the file is there already or cannot be written, its name says no kind, or the source cannot be read.
    """
    if path.exists():
        raise VideoError(f"{path} is there already: give another name, or remove it")
    if path.suffix == ".mp4":
        if source is None:
            raise VideoError(f"{path} needs the frames: say where they come from (--source)")
        return VideoSink(path, source, part)
    if path.suffix not in _KINDS:
        raise VideoError(f"{path}: the name of a sink ends with {', '.join(SUFFIXES)}, which says what it is")
    try:
        return _KINDS[path.suffix](path)
    except OSError as error:
        raise VideoError(f"cannot write {path} ({error.strerror}): give a place that you may write to") from None
