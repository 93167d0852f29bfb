"""The report of a run or of a batch: presence and speed of each object, and doubtful frames."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catstream.base.addresses import is_live
from catstream.base.arrays import Float64
from catstream.base.settings import RunSettings
from catstream.base.tables import write_table
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.output.destinations import Header
from catstream.output.report import clock, round_up, write_page
from catstream.output.track_log import Log
from catstream.video.drawing import Colours, draw
from catstream.video.frames import RATE, jpeg
from catstream.video.source import open_source
from catstream.wire.messages import Track

_PICTURES = 8  #: maximum number of pictures of doubtful frames
_SIDE = 480  #: longest side of a picture, pixels
_POINTS = 1000  #: maximum number of points of a curve
_BINS = 200  #: number of intervals of a video in the plot of mean speeds
_SPEED_SECONDS = 0.25  #: minimum duration over which a speed is averaged
_GAP_SECONDS = 1.0  #: minimum time without a frame that counts as a lost source; also at least five intervals


class Scale(NamedTuple):
    """Size of a pixel in a unit of length."""

    size: float
    unit: str

    @classmethod
    def parse(cls, text: str) -> Scale:
        """Parse a size with its unit; VideoError if it is invalid.

        >>> Scale.parse("0.05mm")
        Scale(size=0.05, unit='mm')
        """
        parts = re.fullmatch(r"(\d*\.?\d+(?:e-?\d+)?)\s*([^\W\d]+)", text)
        if parts is None or not 0 < (size := float(parts[1])) < math.inf:
            raise VideoError(f"expected the size of a pixel with its unit, for example 0.05mm, got {text!r}")
        return cls(size, parts[2])

    def format(self, value: float, per: str = "") -> str:
        """Format a length or a speed, rounded to the size of a pixel."""
        digits = max(0, -math.floor(math.log10(self.size)))
        return "-" if math.isnan(value) else f"{value:.{digits}f} {self.unit}{per}"


#: Columns of the table of objects, in the order of `_Object.row`.
_COLUMNS = ("frames", "present", "doubtful", "absent", "checked", "seconds", "distance", "mean_speed", "maximum_speed")


class _Object:
    """The tracks of an object in n frames.

    frames   int (n,), frame numbers in the source
    times    float64 (n,), seconds
    ends     float64 (n,), seconds: time of the next frame; before a gap, one interval later
    gaps     bool (n - 1,), whether frames are missing after a frame, because the source was lost or for another reason
    steps    float64 (n - 1,), distance from each centre of the box to the next one; NaN next to an absence or a gap
    states   present, doubtful or absent, (n,)
    """

    def __init__(self, tracks: Sequence[Track], rate: float, scale: Scale) -> None:
        self.frames = np.array([track.source_frame for track in tracks])
        self.times: Float64 = np.array([track.time for track in tracks])
        intervals = np.diff(self.times)
        self.interval = float(np.median(intervals) if len(intervals) else 0) or 1 / rate
        are_missing = np.diff([track.frame for track in tracks]) > 1
        self.gaps = (intervals > max(_GAP_SECONDS, 5 * self.interval)) | are_missing
        self.ends = self.times + np.append(np.where(self.gaps, self.interval, intervals), self.interval)
        boxes = np.array([track.box or [np.nan] * 4 for track in tracks], np.float64)
        self.steps: Float64 = scale.size * np.hypot(*np.diff(boxes[:, :2] + boxes[:, 2:] / 2, axis=0).T)
        self.steps[self.gaps] = np.nan
        states = [("doubtful" if track.doubtful else "present") if track.box else "absent" for track in tracks]
        self.states = np.array(states)
        self._checked = float(np.mean([track.checked in ("keyframe", "checked") for track in tracks]))

    def runs(self) -> Iterator[tuple[str, slice]]:
        """Yield each run of frames of one state without a gap."""
        cuts = np.flatnonzero((self.states[1:] != self.states[:-1]) | self.gaps) + 1
        for start, stop in pairwise([0, *cuts, len(self.states)]):
            yield str(self.states[start]), slice(start, stop)

    def row(self) -> list[float]:
        """The values of `_COLUMNS`, NaN if unknown: shares are from 0 to 1, seconds are the time of presence.

        The maximum speed is a mean over a quarter of a second, because boxes jitter from frame to frame.
        """
        distance, tracked = np.nansum(self.steps), np.diff(self.times)[~np.isnan(self.steps)].sum()
        shares = [float(np.mean(self.states == state)) for state in ("present", "doubtful", "absent")]
        seconds = (self.ends - self.times)[self.states != "absent"].sum()
        mean, (_, speeds) = distance / (tracked or np.nan), self.speeds(_SPEED_SECONDS)
        fastest = np.fmax.reduce(speeds, initial=mean)
        return [len(self.states), *shares, self._checked, seconds, distance, mean, fastest]

    def lane(self, start: float, end: float) -> list[tuple[str, float, float, str]]:
        """The bars of a timeline between two times in seconds: state, left edge and width in percent, and tooltip."""
        bars, scale = [], 100 / (end - start)
        for state, frames in self.runs():
            first, last = self.times[frames.start], self.ends[frames.stop - 1]
            numbers = f"frames {self.frames[frames.start]} to {self.frames[frames.stop - 1]}"
            text = f"{state}, {clock(first)} to {clock(last)}, {numbers}"
            bars.append((state, scale * (first - start), scale * (last - first), text))
        return bars

    def speeds(self, seconds: float) -> tuple[Float64, Float64]:
        """Centres and mean speeds of a sliding window of this duration; NaN if part of a window is unknown."""
        if len(self.steps) < (window := max(1, round(seconds / self.interval))):
            return np.empty(0), np.empty(0)
        is_unknown = np.isnan(self.steps)
        rows = np.cumsum([np.nan_to_num(self.steps), np.diff(self.times), is_unknown], axis=1)
        sums = np.pad(rows, [(0, 0), (1, 0)])
        distances, durations, unknown = sums[:, window:] - sums[:, :-window]
        durations[(unknown > 0) | (durations <= 0)] = np.nan
        return (self.times[window:] + self.times[:-window]) / 2, distances / durations


class Section:
    """The section of a report about the log of a video; its attributes are the values of the template."""

    def __init__(self, log: Log, scale: Scale) -> None:
        self._log, self.name, self._header, self.unit = log, log.path.stem, log.header() or Header(), scale.unit
        tracks: dict[tuple[str, int], list[Track]] = {}
        for frame in self._log:
            for track in frame.tracks:
                tracks.setdefault((track.object, track.began), []).append(track)
        self.gap = self._log.gap
        self._labels, self._scale = dict[tuple[str, int], str](), scale
        for (name, began), rows in tracks.items():  # a new object that reuses a name has its own label
            is_other = name in self._labels.values()
            self._labels[name, began] = f"{name}@{rows[0].source_frame}" if is_other else name
        rate = self._header.rate or RATE
        self._objects = {label: _Object(tracks[key], rate, scale) for key, label in self._labels.items()}
        self._palette = Colours()
        self.colours = {label: self._palette.of(label) for label in self._objects}
        self.start = min(item.times[0] for item in self._objects.values())
        self.end = max(item.ends[-1] for item in self._objects.values())
        self.figures = {label or "object": item.row() for label, item in self._objects.items()}
        self.rows = [[label, *_texts(row, scale)] for label, row in self.figures.items()]
        self.lanes = {label: item.lane(self.start, self.end) for label, item in self._objects.items()}
        self.speeds, self.top_speed = self._speeds()
        self.pictures, self.problem = list[tuple[bytes, str]](), ""

    def add_pictures(self) -> None:
        """Draw pictures of doubtful frames; sets `problem` if the source cannot be read."""
        if not self._header.source or is_live(self._header.source):
            self.problem = "the log names no video"
        elif frames := self._doubtful_frames():
            numbered = ((frame.tracks[0].source_frame, frame.tracks) for frame in self._log)
            logged = {number: tracks for number, tracks in numbered if number in frames}
            first, rate = min(frames), self._header.rate or RATE
            # With these settings, the frames are the same as the run's, which may have ended at a damaged one.
            settings = RunSettings(image_rate=rate, skip_damaged=True, resize=True)
            try:
                part = slice(first, max(frames) + 1)
                with open_source(self._header.source, part=part, settings=settings) as source:
                    for number, frame in enumerate(source, first):
                        if number in frames:
                            tracks = [replace(t, object=self._labels[t.object, t.began]) for t in logged[number]]
                            image = draw(frame.image, tracks, self._palette)
                            text = f"frame {number}, {clock(frame.time)}: {frames[number]}"
                            self.pictures.append((jpeg(image, side=_SIDE), text))
            except VideoError as error:
                self.problem = str(error)

    def _doubtful_frames(self) -> dict[int, str]:
        """The middle frame of each of the longest doubtful runs, and its description."""
        runs = [
            (frames.stop - frames.start, int(item.frames[(frames.start + frames.stop) // 2]), name)
            for name, item in self._objects.items()
            for state, frames in item.runs()
            if state == "doubtful"
        ]
        longest = sorted(runs, reverse=True)[:_PICTURES]
        return {frame: f"{name or 'the object'}, {counted(count, 'doubtful frame')}" for count, frame, name in longest}

    def _speeds(self) -> tuple[dict[str, list[str]], float]:
        """The polylines of the speed of each object in a plot of 1000 x 460, and the speed at its upper edge."""
        duration = self.end - self.start
        speeds = {name: item.speeds(max(_SPEED_SECONDS, duration / _BINS)) for name, item in self._objects.items()}
        fastest = max(self._scale.size, *(np.fmax.reduce(values, initial=0) for _, values in speeds.values()))
        top = round_up(fastest)
        lines = {}
        for name, (middles, values) in speeds.items():
            points = np.column_stack([1000 * (middles - self.start) / duration, 460 - 440 * values / top])
            points = points[:: len(points) // _POINTS + 1]
            parts = np.split(points, np.flatnonzero(np.diff(np.isnan(points[:, 1]))) + 1)
            curves = (part for part in parts if len(part) and not np.isnan(part[0, 1]))
            lines[name] = [" ".join(f"{x:.1f},{y:.1f}" for x, y in curve) for curve in curves]
        return lines, top


def _texts(row: Sequence[float], scale: Scale) -> list[str]:
    """Format the cells of a row of the page."""
    frames, *shares, checked, seconds, distance, mean, fastest = row
    speeds = (scale.format(speed, "/s") for speed in (mean, fastest))
    texts = [f"{frames:.0f}", *(f"{share:.1%}" for share in shares), f"{checked:.1%}" if checked else "-"]
    return [*texts, f"{seconds:.1f} s", scale.format(distance), *speeds]


def write_report(path: Path, table: Path, sections: Sequence[Section]) -> None:
    """Write the page of the videos, and the CSV table of their objects."""
    write_page(path, "tracks.html", sections=sections)
    rows = (
        (section.name, label, *("" if math.isnan(value) else f"{value:.6g}" for value in row), section.unit)
        for section in sections
        for label, row in section.figures.items()
    )
    write_table(table, ("video", "object", *_COLUMNS, "unit"), rows, VideoError)
