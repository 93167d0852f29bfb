"""Shared by the commands: tables, errors and progress lines on the terminal, Ctrl-C, and checks of the files to write.

In all commands, slow imports are in the functions that need them, so that `--help` is fast.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from catstream.base.addresses import without_passwords
from catstream.errors import ServiceError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, ProgressColumn, TextColumn
    from rich.table import Table

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
#: Seconds between two lines about long work if the messages do not go to a terminal.
LINE_SECONDS = 30.0

_WIDTH = 140  # columns of a table that is not printed to a terminal


def screen() -> Console:
    """The console of standard output, for tables."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else _WIDTH, markup=False, emoji=False)


def messages() -> Console:
    """The standard error, for the progress, and lines of text above it."""
    from rich.console import Console

    return Console(stderr=True, soft_wrap=True, highlight=False, markup=False, emoji=False)


def complain(problem: object) -> None:
    """Print a problem in a line that begins with the name of the program; passwords in addresses are removed."""
    click.echo(f"catstream: {without_passwords(str(problem))}", err=True)


def table(*headings: str, right: Collection[str] = ()) -> Table:
    """A table without lines, whose columns `right` are aligned to the right."""
    from rich.table import Table

    columns = Table(box=None, header_style="bold", pad_edge=False)
    for heading in headings:
        columns.add_column(heading, justify="right" if heading in right else "left", overflow="fold")
    return columns


def line_of(console: Console, *columns: ProgressColumn) -> Progress:
    """A progress display of one line, which is erased at its end; without a terminal, a line every `LINE_SECONDS`.

    columns : by default the description, a bar, how much of the total is done, and the time that remains
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TimeRemainingColumn

    class Line(Progress):
        printed = time.monotonic()

        def update(self, task_id: TaskID, **fields: Any) -> None:
            super().update(task_id, **fields)
            if self.disable and time.monotonic() > self.printed + LINE_SECONDS:
                self.printed = time.monotonic()
                console.print(*(part(self.tasks[task_id]) for part in parts if not isinstance(part, BarColumn)))

    parts = columns or (text("{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn())
    hidden, wide = not console.is_terminal, parts[-1].get_table_column().ratio is not None
    return Line(*parts, console=console, transient=True, expand=wide, refresh_per_second=8, disable=hidden)


def text(form: str, *, last: bool = False) -> TextColumn:
    """A column of a progress display; the last one fills the line, and is cut in a narrow terminal."""
    from rich.progress import TextColumn
    from rich.table import Column

    return TextColumn(form, markup=False, table_column=Column(no_wrap=True, ratio=1 if last else None))


class Interrupts:
    """Raises KeyboardInterrupt for Ctrl-C, SIGTERM and the loss of the terminal, except in the blocks below."""

    def __init__(self) -> None:
        self._leaving = self._deferring = self._pending = False
        #: Exit code of an interrupted command, by the convention of shells: 130 for Ctrl-C, 143 for SIGTERM.
        self.exit_code = 128 + signal.SIGINT

    def install(self) -> None:
        """Install the handlers. A signal that is ignored, as under nohup, stays ignored, except SIGTERM."""
        for number in _SIGNALS:
            if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._handle)
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)

    @contextmanager
    def leaving(self) -> Iterator[None]:
        """Exit at once on these signals, during imports before any work.

        Kernels are compiled during these imports, and the compiler hides a KeyboardInterrupt, or raises another error.
        """
        self._leaving = True
        try:
            yield
        finally:
            self._leaving = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defer these signals to the end of a block."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
            pending, self._pending = self._pending, False
        if pending:
            raise KeyboardInterrupt

    def end(self) -> None:
        """Ignore these signals from now on: they would only interrupt the cleanup of the process."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, _: object) -> None:
        self.exit_code = 128 + number
        if self._leaving:
            os.write(2, b"stopped\n")
            os._exit(self.exit_code)
        if not self._deferring:
            raise KeyboardInterrupt
        self._pending = True


#: The handlers of this process; the command line installs them.
INTERRUPTS = Interrupts()


def stopped(result: str = "") -> NoReturn:
    """End an interrupted command; print where the results are, or how to continue."""
    click.echo(f"stopped: {result}" if result else "stopped", err=True)
    raise SystemExit(INTERRUPTS.exit_code)


def _with_file(name: str, suffix: str, help: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """An option for an output file, which is checked before the work; only a file with the suffix is replaced."""

    def checked(_: click.Context, __: click.Parameter, file: Path | None) -> Path | None:
        from catstream.base.files import check_file

        if file is not None:
            if file.is_file() and file.suffix != suffix:
                raise ServiceError(f"{file} exists already, and only a file whose name ends with {suffix} is replaced")
            check_file(file)
        return file

    return click.option(f"--{name}", f"{name}_file", type=click.Path(path_type=Path), callback=checked, help=help)


with_json_file = _with_file("json", ".json", "File for all figures.")
with_raw_file = _with_file("raw", ".csv", "CSV file for the latency of each frame.")
with_report_file = _with_file("report", ".html", "HTML file for a report.")


def write_json(file: Path | None, figures: dict[str, object]) -> None:
    from catstream.base.files import writing

    if file is not None:
        with writing(file):
            file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
