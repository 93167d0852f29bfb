"""What the commands share: tables, errors and progress on the terminal, Ctrl-C, and checks of the files to write.

`catstream --help` imports this module: what takes long is imported in the functions that need it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column, Table
from rich.text import Text

from catstream.errors import ServiceError

if TYPE_CHECKING:
    from catstream.messages.kinds import Track
    from catstream.pipeline import Pipeline

#: Exit code of a command that was interrupted.
INTERRUPTED = 130

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_WIDTH = 140  # columns of a table that is not printed to a terminal
_SHORTEST_SECONDS = 1.0  # of a run whose rate is told
_REFRESH_SECONDS = 0.1  # between two updates of the progress


def screen() -> Console:
    """The standard output, for tables."""
    return Console(width=None if sys.stdout.isatty() else _WIDTH, markup=False, emoji=False)


def messages() -> Console:
    """The standard error, for the progress, and lines of text above it."""
    return Console(stderr=True, soft_wrap=True, highlight=False, markup=False, emoji=False)


def complain(problem: object) -> None:
    """Print a problem in one line that begins with the name of the program."""
    click.echo(f"catstream: {problem}", err=True)


def table(*heads: str, right: Collection[str] = ()) -> Table:
    """A table without lines, whose columns `right` are aligned to the right."""
    made = Table(box=None, header_style="bold", pad_edge=False)
    for head in heads:
        made.add_column(head, justify="right" if head in right else "left", overflow="fold")
    return made


def line_of(console: Console, *columns: ProgressColumn) -> Progress:
    """A progress display of one line, which is erased at its end; nothing if the console is not a terminal.

    columns : by default the description, a bar, and how much of the total is done
    """
    shown = columns or (text("{task.description}"), BarColumn(24), MofNCompleteColumn())
    hidden, wide = not console.is_terminal, shown[-1].get_table_column().ratio is not None
    return Progress(*shown, console=console, transient=True, expand=wide, refresh_per_second=8, disable=hidden)


def text(form: str, *, last: bool = False) -> TextColumn:
    """A column of a progress display; the last one gets the room that is left, and is cut in a narrow terminal."""
    return TextColumn(form, markup=False, table_column=Column(no_wrap=True, ratio=1 if last else None))


class Interrupts:
    """Raises KeyboardInterrupt for Ctrl-C, SIGTERM and the loss of the terminal, except in the blocks below."""

    def __init__(self) -> None:
        self._leaving = self._deferring = self._pending = False

    def install(self) -> None:
        """Install the handlers. A signal that is ignored, as under nohup, stays ignored, except SIGTERM."""
        for number in _SIGNALS:
            if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._handle)

    @contextmanager
    def leaving(self) -> Iterator[None]:
        """A block in which these signals end this process at once, for imports before any work.

        Kernels are compiled during these imports, and the compiler hides a KeyboardInterrupt or makes another error of
        it.
        """
        self._leaving = True
        try:
            yield
        finally:
            self._leaving = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """A block that these signals interrupt at its end only."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
            pending, self._pending = self._pending, False
        if pending:
            raise KeyboardInterrupt

    def end(self) -> None:
        """Ignore these signals from now on: the process ends, and they would only interrupt its last cleaning up."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, *_: object) -> None:
        if self._leaving:
            os.write(2, b"stopped\n")
            os._exit(INTERRUPTED)
        if not self._deferring:
            raise KeyboardInterrupt
        self._pending = True


#: The handlers of this process; the command line installs them.
INTERRUPTS = Interrupts()


def stopped(result: str = "") -> NoReturn:
    """End a command that was interrupted; say what is there so far, and how to continue."""
    click.echo(f"stopped: {result}" if result else "stopped", err=True)
    raise SystemExit(INTERRUPTED)


def check_file(file: Path, *, overwrite: bool, made: Path | None = None) -> None:
    """Check before the work that a file can be written: ServiceError if it exists, or its folder is not writable.

    overwrite : whether it may exist
    made : a folder that is made before the file, if it does not exist
    """
    from catstream.messages.storage import is_writable

    if file.exists() and not overwrite:
        raise ServiceError(f"{file} exists already: replace it with --overwrite, or give another name")
    folder = file.parent.absolute()
    if made is not None and folder == made.absolute():
        folder = next(each for each in (folder, *folder.parents) if each.exists())
    if file.is_dir() or not is_writable(folder):
        raise ServiceError(f"cannot write {file}: give a file in a folder that exists and that you may write to")


def _checked(_: click.Context, __: click.Parameter, file: Path | None) -> Path | None:
    if file is not None:
        if file.is_file() and file.suffix != ".json":
            raise ServiceError(f"{file} exists already, and only a file whose name ends with .json is replaced")
        check_file(file, overwrite=True)
    return file


with_json_file = click.option(
    "--json", "json_file", type=click.Path(path_type=Path), callback=_checked, help="File for all figures."
)


def write_json(file: Path | None, figures: dict[str, object]) -> None:
    """Write figures to a file, if one is given."""
    from catstream.messages.storage import writing

    if file is not None:
        with writing(file):
            file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


@dataclass(slots=True)
class _Counted:
    """The counters of an object: frames in which it was tracked, and present; the newest version of its model."""

    frames: int = 0
    present: int = 0
    version: int = 0


class _State(ProgressColumn):
    """The state of the objects; while there are no tracks, why: the source is lost, or the run is paused or waits."""

    def __init__(self, pipeline: Pipeline) -> None:
        super().__init__(Column(no_wrap=True))
        self._pipeline = pipeline

    def render(self, task: Task) -> Text:
        lost = self._pipeline.lost_seconds
        return Text(f"{f'lost {lost:.0f} s' if lost else self._pipeline.holding or task.description:13}")


class RunProgress:
    """Counts the tracks of a run, and shows them during the run and at its end."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._started = time.perf_counter()
        self._first = self._shown = 0.0
        self.frames = 0
        self._objects: dict[str, _Counted] = {}

    def progress(self, console: Console) -> Progress:
        total = "" if self._pipeline.live else f"/{self._pipeline.frames or '?'}"
        count = text("{task.completed:.0f}" + total)
        progress = line_of(console, _State(self._pipeline), count, text("{task.fields[figures]}", last=True))
        self._task = progress.add_task("starting", total=self._pipeline.frames, figures="")
        return progress

    def show(self, progress: Progress, tracks: Mapping[str, Track]) -> None:
        """Count and show the tracks of a frame."""
        now = time.perf_counter()
        if not self.frames:
            self._first = now - self._started
        self.frames += 1
        for name, track in tracks.items():
            each = self._objects.setdefault(name, _Counted())
            each.frames += 1
            each.present += track.box is not None
            each.version = track.model_version
        if not progress.disable and now - self._shown >= _REFRESH_SECONDS:
            self._shown = now
            progress.update(
                self._task, completed=self.frames, description=_state(tracks), figures=self._figures(tracks)
            )

    def _figures(self, tracks: Mapping[str, Track]) -> str:
        figures = [f"{self._rate(time.perf_counter()):.0f} frames/s"]
        if self._pipeline.live:
            figures.append(f"{self._detector('skipped'):.0f} skipped")
        if len(tracks) == 1:
            (track,) = tracks.values()
            figures += [f"score {track.score:+.2f}", f"model {track.model_version}"]
        else:
            figures += [f"{name or '(no name)'} {track.score:+.2f}" for name, track in tracks.items()]
        return "  ".join([*figures, f"{self._pipeline.health.get('compressor', {}).get('leaves', 0):.0f} leaves"])

    def summary(self, results: Sequence[Path]) -> str:
        """The closing lines of the run."""
        from catstream.messages.names import UNNAMED, counted

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
        """A line for each object."""
        for name, each in self._objects.items():
            frames = f"present in {each.present} of {each.frames} frames, model version {each.version}"
            yield f"  {name or '(no name)'}: {frames}"

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


def _shown(path: Path) -> str:
    """A path relative to the current folder, if it is in it."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
