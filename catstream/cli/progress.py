"""The progress line of `catstream track`, and the summary at its end."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, Task

from catstream.cli.output import line_of
from catstream.messages.kinds import Track
from catstream.messages.names import UNNAMED, counted
from catstream.pipeline import Pipeline

_SHORTEST_SECONDS = 1.0  # of a run whose rate is told


@dataclass(slots=True)
class _Object:
    """The counters of an object: frames in which it was tracked, and present; the newest version of its model."""

    frames: int = 0
    present: int = 0
    version: int = 0


class RunProgress:
    """Counts the tracks of a run, and shows them during the run and at its end.

    Parameters
    ----------
    names : the objects of the earlier part of a resumed run, in the order in which they appeared
    """

    def __init__(self, pipeline: Pipeline, names: Iterable[str] = ()) -> None:
        self._pipeline = pipeline
        self._started = time.perf_counter()
        self._first = 0.0
        self._shown = 0.0
        self.frames = 0
        self._objects = {name: _Object() for name in names}

    def progress(self, console: Console) -> Progress:
        progress = line_of(console, self._line)
        self._task = progress.add_task("", total=self._pipeline.frames, state="starting", figures=())
        return progress

    def _line(self, task: Task) -> list[str]:
        # If there are no tracks: the source is lost, or the run is paused or waits for a box.
        lost = self._pipeline.lost_seconds
        state = f"lost {lost:.0f} s" if lost else self._pipeline.holding or task.fields["state"]
        total = "" if self._pipeline.live else f"/{'?' if task.total is None else int(task.total)}"
        return [f"{state:13}", f"{int(task.completed)}{total}", *task.fields["figures"]]

    def show(self, progress: Progress, tracks: Mapping[str, Track]) -> None:
        """Count the tracks of a frame, and show them if the last ones were shown a while ago."""
        now = time.perf_counter()
        if not self.frames:
            self._first = now - self._started
        self.frames += 1
        for name, track in tracks.items():
            each = self._objects.setdefault(name, _Object())
            each.frames += 1
            each.present += track.box is not None
            each.version = track.model_version
        if now - self._shown < 0.1:
            return
        self._shown = now
        leaves = self._pipeline.health.get("compressor", {}).get("leaves", 0)
        figures = (
            f"{self._rate(now):.0f} frames/s",
            *([f"{self._detector('skipped'):.0f} skipped"] if self._pipeline.live else []),
            *_figures(tracks),
            f"{leaves:.0f} leaves",
        )
        progress.update(self._task, completed=self.frames, state=_state(tracks), figures=figures)

    def summary(self, results: Sequence[Path]) -> str:
        """The closing lines of the run."""
        rate = f"first track after {self._first:.2f} s"
        if (now := time.perf_counter()) - self._started - self._first >= _SHORTEST_SECONDS:
            rate = f"{self._rate(now):.0f} frames/s, {rate}"
        frames = counted(self.frames, "frame")
        if self._objects.keys() == {UNNAMED}:
            alone = self._objects[UNNAMED]
            lines = [f"{frames}, present in {alone.present}, {rate}, model version {alone.version}"]
        else:
            lines = [f"{frames}, {rate}", *self._of_each()]
        if self._pipeline.live:
            lines.append(
                f"live: {counted(self._detector('skipped'), 'frame')} skipped, "
                f"lost and opened again {counted(self._detector('reopened'), 'time')}"
            )
        if damaged := self._detector("damaged"):
            lines.append(f"damaged: {counted(damaged, 'frame')} could not be decoded, and skipped")
        if totals := self._pipeline.totals:
            lines.append(
                f"features: {counted(totals['sent'], 'message')} sent, {totals['stored']} stored in the coreset trees"
            )
        if self._pipeline.restarts:
            lines.append(f"processes restarted: {self._pipeline.restarts}")
        if results:
            lines.append(f"results: {', '.join(map(_shown, results))}")
        return "\n".join(lines)

    def _of_each(self) -> Iterator[str]:
        """A line for each object; the numbers are the ids in MOT text."""
        for number, (name, each) in enumerate(self._objects.items(), 1):
            frames = f"present in {each.present} of {counted(each.frames, 'frame')}, model version {each.version}"
            yield f"  {number} {name or '(no name)'}: {frames}"

    def _detector(self, counter: str) -> float:
        """A counter of the detector: the final one, or before the end that of its last report."""
        return (self._pipeline.health.get("detector", {}) | self._pipeline.totals).get(counter, 0)

    def _rate(self, now: float) -> float:
        return (self.frames - 1) / max(now - self._started - self._first, 1e-9)


def _state(tracks: Mapping[str, Track]) -> str:
    """The state of the only object, or how many objects are present."""
    if len(tracks) == 1:
        (track,) = tracks.values()
        return track.state
    return f"{sum(track.box is not None for track in tracks.values())}/{len(tracks)} present"


def _figures(tracks: Mapping[str, Track]) -> list[str]:
    """Score and model version of the only object, or the name and score of each."""
    if len(tracks) == 1:
        (track,) = tracks.values()
        return [f"score {track.score:+.2f}", f"model {track.model_version}"]
    return [f"{name or '(no name)'} {track.score:+.2f}" for name, track in tracks.items()]


def _shown(path: Path) -> str:
    """A path relative to the current folder, if it is in it."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
