"""The report of a run, or of the runs of a batch: where each object was, how fast, and which frames to look at."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catstream.base.addresses import is_live
from catstream.base.arrays import Float64
from catstream.base.settings import RunSettings
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.reports.report import clock, write_page
from catstream.sinks.destinations import Head
from catstream.sinks.track_log import Log
from catstream.video.drawing import Colours, draw
from catstream.video.frames import RATE, jpeg
from catstream.video.source import open_source

_PICTURES = 8  #: most frames to look at in a video
_SIDE = 480  #: of a picture, pixels
_BINS = 200  #: of the plot of the speed


class _Bar(NamedTuple):
    """Consecutive frames of one state in a timeline: place and width in percent, and the text of its tooltip."""

    state: str
    left: float
    width: float
    text: str


class _Picture(NamedTuple):
    """A frame to look at, a JPEG file."""

    jpeg: bytes
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class _Object:
    """The tracks of an object.

    frames   int (n,), their numbers
    times    float64 (n,), seconds
    steps    float64 (n - 1,), distance from each centre of the box to the next one, pixels; NaN beside an absence
    states   present, doubtful or absent
    checked  share of the frames that are keyframes or checked, from 0 to 1
    """

    frames: np.ndarray
    times: Float64
    steps: Float64
    states: list[str]
    checked: float

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> _Object:
        boxes = np.array([track.box or [np.nan] * 4 for track in tracks], np.float64)
        return cls(
            np.array([track.frame for track in tracks]),
            np.array([track.time for track in tracks]),
            np.hypot(*np.diff(boxes[:, :2] + boxes[:, 2:] / 2, axis=0).T),
            [("doubtful" if track.doubtful else "present") if track.box else "absent" for track in tracks],
            float(np.mean([track.checked in ("keyframe", "checked") for track in tracks])),
        )

    def runs(self) -> Iterator[tuple[str, slice]]:
        """Yield the stretches of frames with one state."""
        start = 0
        for state, group in groupby(self.states):
            stop = start + len([*group])
            yield state, slice(start, stop)
            start = stop

    def row(self, name: str) -> list[str]:
        """The row of the table."""
        distance, tracked = np.nansum(self.steps), np.diff(self.times)[~np.isnan(self.steps)].sum()
        shares = (self.states.count(state) / len(self.states) for state in ("present", "doubtful", "absent"))
        return [
            name or "object",
            str(len(self.states)),
            *(f"{share:.1%}" for share in shares),
            f"{self.checked:.1%}" if self.checked else "-",
            f"{distance:.0f} px",
            f"{distance / tracked:.0f} px/s" if tracked else "-",
        ]

    def lane(self, duration: float) -> list[_Bar]:
        """Its bars in the timeline of a video of this duration in seconds."""
        bars, scale = [], 100 / duration
        ends = [*self.times[1:], duration]
        for state, frames in self.runs():
            first, last = self.times[frames.start], ends[frames.stop - 1]
            numbers = f"frames {self.frames[frames.start]} to {self.frames[frames.stop - 1]}"
            text = f"{state}, {clock(first)} to {clock(last)}, {numbers}"
            bars.append(_Bar(state, scale * first, scale * (last - first), text))
        return bars

    def speeds(self, edges: Float64) -> Float64:
        """Mean speed in px/s between neighbours of `edges`, seconds; NaN while it is absent."""
        tracked = ~np.isnan(self.steps)
        middles, seconds = ((self.times[1:] + self.times[:-1]) / 2)[tracked], np.diff(self.times)[tracked]
        distances, _ = np.histogram(middles, edges, weights=self.steps[tracked])
        durations, _ = np.histogram(middles, edges, weights=seconds)
        speeds: Float64 = np.where(durations > 0, distances / np.where(durations > 0, durations, 1), np.nan)
        return speeds


class Section:
    """The part of the report about a video; its attributes are the values of the template.

    Raises VideoError if the log cannot be read, or contains no track.
    """

    def __init__(self, path: Path, *, skip_damaged: bool = False) -> None:
        self._log = Log(path, skip_damaged=skip_damaged)
        self.name, self._head = path.stem, self._log.head() or Head()
        tracks: dict[str, list[Track]] = {}
        for frame in self._log:
            for track in frame.tracks:
                tracks.setdefault(track.object, []).append(track)
        if not tracks:
            raise VideoError(f"{path} contains no track: pass the log of a run")
        self.gap = self._log.gap
        self._objects = {name: _Object.of(rows) for name, rows in tracks.items()}
        self._palette = Colours()
        self.colours = {name: self._palette.of(name) for name in tracks}
        self.duration = max(item.times[-1] for item in self._objects.values()) + 1 / (self._head.rate or RATE)
        self.rows = [item.row(name) for name, item in self._objects.items()]
        self.lanes = {name: item.lane(self.duration) for name, item in self._objects.items()}
        self.speeds, self.top_speed = self._speeds()
        self.pictures, self.problem = list[_Picture](), ""

    def add_pictures(self) -> None:
        """Read the frames to look at from the source; note a problem if it cannot be read."""
        if not self._head.source or is_live(self._head.source):
            self.problem = "the log names no video"
        elif frames := self._frames_to_look_at():
            logged = {frame.number: frame for frame in self._log if frame.number in frames}
            part, rate = slice(self._head.start, None, self._head.stride), self._head.rate or RATE
            # A run skips damaged frames and scales others, or ends at the first: in any case these are its frames.
            settings = RunSettings(image_rate=rate, skip_damaged=True, resize=True)
            try:
                with open_source(self._head.source, part=part, settings=settings) as source:
                    for frame in islice(source, max(frames) + 1):
                        if frame.number in frames:
                            image = draw(frame.image, logged[frame.number].tracks, self._palette)
                            text = f"frame {frame.number}, {clock(frame.time)}: {frames[frame.number]}"
                            self.pictures.append(_Picture(jpeg(image, side=_SIDE), text))
            except VideoError as error:
                self.problem = str(error)

    def _frames_to_look_at(self) -> dict[int, str]:
        """The middle of each of the longest doubtful stretches, and what is doubtful there."""
        runs = [
            (frames.stop - frames.start, int(item.frames[(frames.start + frames.stop) // 2]), name)
            for name, item in self._objects.items()
            for state, frames in item.runs()
            if state == "doubtful"
        ]
        longest = sorted(runs, reverse=True)[:_PICTURES]
        return {frame: f"{name or 'the object'}, {counted(count, 'doubtful frame')}" for count, frame, name in longest}

    def _speeds(self) -> tuple[dict[str, list[str]], float]:
        """The polylines of the speed of each object in a plot of 1000 x 460, and the speed at its upper end."""
        edges = np.linspace(0, self.duration, min(_BINS, max(2, int(self.duration * 4))) + 1)
        speeds = {name: item.speeds(edges) for name, item in self._objects.items()}
        fastest = max(1.0, *(float(np.nanmax(item, initial=0)) for item in speeds.values()))
        step = 10 ** np.floor(np.log10(fastest)) / 2
        top = step * np.ceil(fastest / step)  # a round number
        xs = 1000 * (edges[1:] + edges[:-1]) / 2 / self.duration
        lines = {}
        for name, values in speeds.items():
            points = np.column_stack([xs, 460 - 440 * values / top])
            parts = np.split(points, np.flatnonzero(np.diff(np.isnan(values))) + 1)
            lines[name] = [" ".join(f"{x:.1f},{y:.1f}" for x, y in part) for part in parts if not np.isnan(part[0, 1])]
        return lines, float(top)


def write_report(path: Path, sections: Iterable[Section]) -> Path:
    """Write the report of videos."""
    return write_page(path, "tracks.html", sections=[*sections])
