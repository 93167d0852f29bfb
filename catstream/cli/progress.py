"""Counts the tracks of a run, and shows them during the run and at its end."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from catstream.base.names import UNNAMED
from catstream.base.text import counted
from catstream.cli.common import LINE_SECONDS
from catstream.pipeline import Pipeline
from catstream.video.frames import describe_counters
from catstream.wire.messages import Track

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status

#: Seconds between two updates of the line on the terminal.
REFRESH_SECONDS = 0.1

_SHORTEST_SECONDS = 1.0  # a shorter run is reported without its frames per second


@dataclass(slots=True)
class _ObjectCounts:
    """The counters of an object: frames in which it was tracked, and present; the newest version of its model."""

    frames: int = 0
    present: int = 0
    version: int = 0


class RunProgress:
    """Counts the tracks of a run."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._paused_seconds = 0.0  # without tracking: paused, without a box, or without the source
        self._updated = time.perf_counter()
        self._started = self._now()
        self._first, self._refreshed = 0.0, self._updated
        self.frames = self.not_written = 0
        self._objects: dict[str, _ObjectCounts] = {}
        self._tracks: Mapping[str, Track] = {}  # of the newest frame

    def _now(self) -> float:
        """A clock, in seconds, that pauses while the run is paused, waits for a box, or has lost its source."""
        return self._updated - self._paused_seconds

    def count(self, tracks: Mapping[str, Track]) -> None:
        """Count the tracks of a frame."""
        self._updated, self._tracks = time.perf_counter(), tracks
        self._first = self._first or self._now() - self._started
        self.frames += 1
        for name, track in tracks.items():
            counts = self._objects.setdefault(name, _ObjectCounts())
            counts.frames += 1
            counts.present += track.box is not None
            counts.version = track.model_version

    def idle(self) -> None:
        """Update the clock while there is no frame."""
        before, self._updated = self._updated, time.perf_counter()
        if self._pipeline.holding:
            self._paused_seconds += self._updated - before

    def show(self, status: Status, console: Console) -> None:
        """Update the line on a terminal; without one, print it every `LINE_SECONDS`, unless the source is live."""
        if self._updated - self._refreshed < (REFRESH_SECONDS if console.is_terminal else LINE_SECONDS):
            return
        self._refreshed = self._updated
        if console.is_terminal:
            from rich.text import Text

            status.update(Text(self.line(), no_wrap=True, overflow="ellipsis"))
        elif not self._pipeline.live:
            console.print(self.line())

    def line(self) -> str:
        """The state of the objects and the run, with figures of the newest frame."""
        pipeline, tracks = self._pipeline, self._tracks
        if pipeline.holding or not tracks:
            lost = pipeline.lost_seconds
            return f"lost {lost:.0f} s" if lost else pipeline.holding or "starting"
        count = f"{self.frames}" if pipeline.live else f"{self.frames}/{pipeline.frames or '?'}"
        figures = [count, f"{self._rate():.0f} frames/s"]
        if pipeline.live:
            figures.append(f"{self._counters.get('skipped', 0):.0f} skipped")
            figures += [f"{self.not_written} not written"] * bool(self.not_written)
        if len(tracks) == 1:
            (track,) = tracks.values()
            state = str(track.state)
            figures += [f"score {track.score:+.2f}", f"model {track.model_version}"]
        else:
            state = f"{sum(track.box is not None for track in tracks.values())}/{len(tracks)} present"
            figures += [f"{name or '(no name)'} {track.score:+.2f}" for name, track in tracks.items()]
        figures.append(f"{pipeline.health.get('compressor', {}).get('leaves', 0):.0f} leaves")
        return f"{state:13} {'  '.join(figures)}"

    def summary(self) -> str:
        """The closing lines of the run."""
        self.idle()
        rate = f"first track after {self._first:.2f} s"
        if self._seconds() >= _SHORTEST_SECONDS:
            rate = f"{self._rate():.0f} frames/s, {rate}"
        frames = counted(self.frames, "frame")
        if self._objects.keys() == {UNNAMED}:
            alone = self._objects[UNNAMED]
            lines = [f"{frames}, present in {alone.present}, {rate}, model version {alone.version}"]
        else:
            lines = [f"{frames}, {rate}"]
            for name, counts in self._objects.items():
                present = f"present in {counts.present} of {counts.frames} frames"
                lines.append(f"  {name or '(no name)'}: {present}, model version {counts.version}")
        if self._pipeline.live:
            skipped = counted(self._counters.get("skipped", 0), "frame")
            reconnects = counted(self._counters.get("reconnects", 0), "reconnect")
            lines.append(f"live: {skipped} skipped, {reconnects}")
        lines += describe_counters(self._counters)
        if totals := self._pipeline.totals:
            sent = counted(totals["sent"], "message")
            lines.append(f"features: {sent} sent, {totals['stored']} stored in the coreset trees")
        if self._pipeline.restarts:
            lines.append(f"processes restarted: {self._pipeline.restarts}")
        if self.not_written:
            lines.append(f"not written: {counted(self.not_written, 'frame')}")
        files = [self._pipeline.results.output, *(self._pipeline.results.write or ())]
        if results := [str(file) for file in files if file is not None and file.exists()]:
            here = f"{Path.cwd()}/"
            lines.append(f"results: {', '.join(path.removeprefix(here) for path in results)}")
        elif files == [None] and self._pipeline.results.write is None:
            lines.append("results: none; --output DIR stores them")
        return "\n".join(lines)

    @property
    def _counters(self) -> dict[str, float]:
        """The counters in the last health report of the detector; after the end of the run, the totals."""
        return self._pipeline.health.get("detector", {}) | self._pipeline.totals

    def _rate(self) -> float:
        return (self.frames - 1) / max(self._seconds(), 1e-9)

    def _seconds(self) -> float:
        """Seconds since the first track."""
        return self._now() - self._started - self._first
