"""The output that all commands share: tables, the progress in one line, and errors."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection

import click
from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.table import Table
from rich.text import Text

_WIDTH = 140  # columns of a table that is not printed to a terminal
_BAR = 24  # columns of the bar, at most
_SHORTEST_BAR = 6


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
    """A table without lines.

    Parameters
    ----------
    right : the columns that are aligned to the right, those of numbers
    """
    made = Table(box=None, header_style="bold", pad_edge=False)
    for head in heads:
        made.add_column(head, justify="right" if head in right else "left", overflow="fold")
    return made


def _counted(task: Task) -> list[str]:
    total = "?" if task.total is None else f"{task.total:.0f}"
    return [task.description, f"{task.completed:.0f}/{total}"]


class _Line(ProgressColumn):
    def __init__(self, console: Console, parts: Callable[[Task], list[str]]) -> None:
        super().__init__()
        self._console, self._parts = console, parts

    def render(self, task: Task) -> Text:
        parts, room = self._parts(task), self._console.width - 1
        while len(line := "  ".join(parts)) > room and len(parts) > 2:
            parts.pop()
        bar = min(_BAR, room - len(line) - 2)
        if task.total and bar >= _SHORTEST_BAR:
            done = round(bar * min(task.completed / task.total, 1.0))
            parts.insert(1, "━" * done + "─" * (bar - done))
        return Text("  ".join(parts), no_wrap=True, overflow="ellipsis")


def line_of(console: Console, parts: Callable[[Task], list[str]] = _counted) -> Progress:
    """A progress display of one line, which is erased at its end; nothing if the console is not a terminal.

    Parameters
    ----------
    parts : returns the texts of the line for a task, the most important first; by default its description, and how much
        of its total is done. In a narrow terminal the last ones are left out. If the total is known, a bar follows the
        first text.
    """
    hidden = not console.is_terminal
    return Progress(_Line(console, parts), console=console, transient=True, refresh_per_second=8, disable=hidden)
