"""The progress line of `catstream track`, and the summary at its end."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.text import Text

from catstream.messages import Track
from catstream.pipeline import Pipeline
from catstream.sinks.sink import STDOUT

__all__ = ["RunProgress"]


class _Line(ProgressColumn):
    """State, frames and figures on one line: in a narrow terminal those that matter least are left out."""

    _BAR = 24

    def __init__(self, pipeline: Pipeline, console: Console) -> None:
        super().__init__()
        self._pipeline, self._console = pipeline, console

    def render(self, task: Task) -> Text:
        # If there are no tracks: the source is lost, or the run is paused or waits for a box.
        lost = self._pipeline.lost_seconds
        state = f"lost {lost:.0f} s" if lost else self._pipeline.holding or task.fields["state"]
        total = "" if self._pipeline.live else f"/{'?' if task.total is None else int(task.total)}"
        parts = [f"{state:13}", f"{int(task.completed)}{total}", *task.fields["figures"]]
        room = self._console.width - 1
        while len(line := "  ".join(parts)) > room and len(parts) > 2:
            parts.pop()
        bar = min(self._BAR, room - len(line) - 2)
        if task.total and bar >= 6:
            done = round(bar * min(task.completed / task.total, 1.0))
            parts.insert(1, "━" * done + "─" * (bar - done))
        return Text("  ".join(parts), no_wrap=True, overflow="ellipsis")


class RunProgress:
    """Counts the tracks of a run, and shows them during the run and at its end."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._started = time.perf_counter()
        self._first = 0.0
        self._shown = 0.0
        self.frames = self.present = 0
        self.version = 0

    def progress(self, console: Console) -> Progress:
        progress = Progress(_Line(self._pipeline, console), console=console, transient=True, refresh_per_second=8)
        self._task = progress.add_task("", total=self._pipeline.frames, state="starting", figures=())
        return progress

    def show(self, progress: Progress, found: Track) -> None:
        now = time.perf_counter()
        if not self.frames:
            self._first = now - self._started
        self.frames += 1
        self.present += found.box is not None
        self.version = found.model_version
        if now - self._shown < 0.1:
            return
        self._shown = now
        leaves = self._pipeline.health.get("compressor", {}).get("leaves", 0)
        figures = (
            f"{self._rate(now):.0f} frames/s",
            *([f"{self._detector('skipped'):.0f} skipped"] if self._pipeline.live else []),
            f"score {found.score:+.2f}",
            f"model {found.model_version}",
            f"{leaves:.0f} leaves",
        )
        progress.update(self._task, completed=self.frames, state=found.state, figures=figures)

    def summary(self, results: Sequence[Path]) -> str:
        lines = [
            f"{self.frames} frames, present in {self.present}, {self._rate(time.perf_counter()):.0f} frames/s, "
            f"first track after {self._first:.2f} s, model version {self.version}"
        ]
        if self._pipeline.live:
            lines.append(
                f"live: {self._detector('skipped'):.0f} frames skipped, "
                f"lost and opened again {self._detector('reopened'):.0f} times"
            )
        if damaged := self._detector("damaged"):
            lines.append(f"damaged: {damaged:.0f} frames could not be decoded, and were skipped")
        if totals := self._pipeline.totals:
            lines.append(f"features: {totals['sent']} messages sent, {totals['stored']} stored in the coreset trees")
        if self._pipeline.restarts:
            lines.append(f"processes restarted: {self._pipeline.restarts}")
        if written := [_shown(file) for file in results if file != STDOUT]:
            lines.append(f"results: {', '.join(written)}")
        return "\n".join(lines)

    def _detector(self, counter: str) -> float:
        return self._pipeline.health.get("detector", {}).get(counter, 0)

    def _rate(self, now: float) -> float:
        return (self.frames - 1) / max(now - self._started - self._first, 1e-9)


def _shown(path: Path) -> str:
    """A path relative to the current folder, if it is in it."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
