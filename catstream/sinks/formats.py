"""The text formats of tracks: NDJSON and CSV hold all tracks and can be read again, MOT text holds boxes."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, get_args

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import State, Track
from catstream.messages.names import check_name
from catstream.sinks.lines import LineSink

_STATES: dict[str, State] = {state: state for state in get_args(State)}


class NdjsonSink(LineSink):
    """Tracks as JSON objects, one on each line, as `Track.to_dict` gives them; a box is [x, y, w, h] or null."""

    def line(self, track: Track) -> str:
        """Return the fields of a track as a JSON object."""
        return json.dumps(track.to_dict())

    @classmethod
    def track(cls, line: str) -> Track:
        """Return the track of a JSON object."""
        fields = json.loads(line)
        return Track(**{**fields, "box": fields["box"] and Box(*fields["box"])})


class StdoutSink(NdjsonSink):
    """Tracks as JSON objects, one on each line, on standard output."""

    def write(self, tracks: Sequence[Track]) -> None:
        """Write the tracks of a frame and flush them."""
        super().write(tracks)
        with self._translated_errors():
            self._file.flush()

    def close(self) -> None:
        """Do nothing: standard output belongs to the process."""

    def _open(self) -> IO[str]:
        return sys.stdout

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # The interpreter flushes standard output again when it exits: that must not fail a second time.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._file.fileno())
            if isinstance(error, BrokenPipeError):  # its reader has ended, as `head` does: not an error of catstream
                raise
            raise VideoError(f"cannot write to standard output any more: {error.strerror}") from None


class CsvSink(LineSink):
    """Tracks as rows of comma-separated values, as in NAME.csv of the results."""

    header = "frame,seconds,state,x,y,w,h,score,model_version,object\n"

    def line(self, track: Track) -> str:
        """Return the row of a track."""
        box = ",,," if track.box is None else format_box(track.box)
        return (
            f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version},{track.object}"
        )

    @classmethod
    def track(cls, line: str) -> Track:
        """Return the track of a row, with `pts`, which is not in the file, as None, and `seq` as without a skipped
        frame."""
        frame, seconds, state, x, y, w, h, score, version, name = line.removesuffix("\n").split(",")
        box = Box(*map(float, (x, y, w, h))) if x else None
        number, name = int(frame), check_name(name)
        return Track(number + 1, number, float(seconds), _STATES[state], box, float(score), int(version), object=name)


def format_box(box: Box) -> str:
    """Return x,y,w,h of a box."""
    return ",".join(f"{value:.4f}" for value in box)


class MotSink(LineSink):
    """Boxes as MOT text, as the tools of MOTChallenge read results: `frame,id,x,y,w,h,conf,-1,-1,-1`.

    Frames, ids and pixels count from 1 there. The first object that appears has the id 1, and a name keeps its id. A
    frame without any object has no line, so the file does not say how many frames there were.
    """

    def __init__(self, path: Path, *, again: bool = False) -> None:
        self._ids: dict[str, int] = {}
        super().__init__(path, again=again)

    def line(self, track: Track) -> str | None:
        """Return the line of a track, None if the object is absent."""
        number = self._ids.setdefault(track.object, len(self._ids) + 1)
        if track.box is None:
            return None
        x, y, w, h = track.box
        return f"{track.frame + 1},{number},{x + 1:.2f},{y + 1:.2f},{w:.2f},{h:.2f},{track.score:.4f},-1,-1,-1"
