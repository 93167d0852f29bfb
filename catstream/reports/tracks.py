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
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.reports.report import clock, write_page
from catstream.sinks.destinations import Head
from catstream.sinks.track_log import Log
from catstream.video.drawing import Colours, draw
from catstream.video.frames import jpeg
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
    boxes    float64 (n, 4), pixels; NaN while it is absent
    states   present, doubtful or absent
    checked  share of the frames that are keyframes or checked, from 0 to 1
    """

    frames: np.ndarray
    times: Float64
    boxes: Float64
    states: list[str]
    checked: float

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> _Object:
        return cls(
            np.array([track.frame for track in tracks]),
            np.array([track.time for track in tracks]),
            np.array([track.box or [np.nan] * 4 for track in tracks], np.float64),
            [("doubtful" if track.doubtful else "present") if track.box else "absent" for track in tracks],
            float(np.mean([track.checked in ("keyframe", "checked") for track in tracks])),
        )

    @property
    def centres(self) -> Float64:
        """Centres of the boxes, float64 (n, 2)."""
        centres: Float64 = self.boxes[:, :2] + self.boxes[:, 2:] / 2
        return centres

    @property
    def steps(self) -> Float64:
        """Distance from each centre to the next one in pixels, float64 (n - 1,); NaN beside an absence."""
        steps: Float64 = np.hypot(*np.diff(self.centres, axis=0).T)
        return steps

    def runs(self) -> Iterator[tuple[str, slice]]:
        """Yield the stretches of frames with one state."""
        start = 0
        for state, group in groupby(self.states):
            stop = start + len([*group])
            yield state, slice(start, stop)
            start = stop

    def row(self, name: str) -> list[str]:
        """The row of the table."""
        steps, seconds = self.steps, np.diff(self.times)
        tracked = seconds[~np.isnan(steps)].sum()
        shares = (self.states.count(state) / len(self.states) for state in ("present", "doubtful", "absent"))
        return [
            name or "object",
            str(len(self.states)),
            *(f"{share:.1%}" for share in shares),
            f"{self.checked:.1%}" if self.checked else "-",
            f"{np.nansum(steps):.0f} px",
            f"{np.nansum(steps) / tracked:.0f} px/s" if tracked else "-",
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

    def polylines(self) -> list[str]:
        """Its path, a polyline in pixels for each stretch of frames with a box."""
        parts = np.split(self.centres, np.flatnonzero(np.diff(np.isnan(self.centres[:, 0]))) + 1)
        return [" ".join(f"{x:.1f},{y:.1f}" for x, y in part) for part in parts if not np.isnan(part[0, 0])]

    def speeds(self, edges: Float64) -> Float64:
        """Mean speed in px/s between neighbours of `edges`, seconds; NaN while it is absent."""
        steps, middles = self.steps, (self.times[1:] + self.times[:-1]) / 2
        tracked = ~np.isnan(steps)
        distance, _ = np.histogram(middles[tracked], edges, weights=steps[tracked])
        seconds, _ = np.histogram(middles[tracked], edges, weights=np.diff(self.times)[tracked])
        speeds: Float64 = np.where(seconds > 0, distance / np.where(seconds > 0, seconds, 1), np.nan)
        return speeds


class Section:
    """The part of the report about a video; its attributes are the values of the template.

    Raises VideoError if the log cannot be read, or contains no track.
    """

    def __init__(self, path: Path, *, skip_damaged: bool = False) -> None:
        log = Log(path, skip_damaged=skip_damaged)
        self.name, self._head = path.stem, log.head() or Head()
        tracks: dict[str, list[Track]] = {}
        for frame in log:
            for track in frame.tracks:
                tracks.setdefault(track.object, []).append(track)
        if not tracks:
            raise VideoError(f"{path} contains no track: pass the log of a run")
        self._objects = {name: _Object.of(rows) for name, rows in tracks.items()}
        self._log, self._palette = log, Colours()
        self.colours = {name: self._palette.of(name) for name in tracks}
        self.duration = max(item.times[-1] for item in self._objects.values()) + 1 / (self._head.rate or 25)
        self.rows = [item.row(name) for name, item in self._objects.items()]
        self.lanes = {name: item.lane(self.duration) for name, item in self._objects.items()}
        self.paths = {name: item.polylines() for name, item in self._objects.items()}
        self.size = self._head.size or self._extent()
        self.speeds, self.top_speed = self._speeds()
        self.background, self.pictures, self.problem = b"", list[_Picture](), ""

    def add_pictures(self) -> None:
        """Read the frames to look at, and one of the middle, from the source; note a problem if it cannot be read."""
        if not self._head.source or is_live(self._head.source):
            self.problem = "the log names no video"
            return
        frames = self._frames_to_look_at()
        middle = int(np.median(np.concatenate([item.frames for item in self._objects.values()])))
        logged = {frame.number: frame for frame in self._log if frame.number in frames}
        try:
            part = slice(self._head.start, None, self._head.stride)
            with open_source(self._head.source, part=part) as source:
                for frame in islice(source, max([middle, *frames]) + 1):
                    if frame.number == middle:
                        self.background = jpeg(frame.image, side=2 * _SIDE)
                    if frame.number in frames:
                        image = draw(frame.image, logged[frame.number].tracks, self._palette)
                        text = f"frame {frame.number}, {clock(frame.time)}: {frames[frame.number]}"
                        self.pictures.append(_Picture(jpeg(image, side=_SIDE), text))
        except VideoError as error:
            self.problem = str(error)

    def _extent(self) -> tuple[int, int]:
        """Width and height around all boxes."""
        ends = [np.nanmax(item.boxes[:, :2] + item.boxes[:, 2:], axis=0, initial=1) for item in self._objects.values()]
        width, height = np.ceil(np.max(ends, axis=0)).astype(int).tolist()
        return width, height

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
