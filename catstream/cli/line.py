"""A progress line that fits the terminal."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.text import Text

__all__ = ["line_of"]

_BAR = 24  # columns of the bar, at most
_SHORTEST_BAR = 6


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


def line_of(console: Console, parts: Callable[[Task], list[str]]) -> Progress:
    """A progress display of one line, which is erased at its end.

    Parameters
    ----------
    parts : returns the texts of the line for a task, the most important first. In a narrow terminal the last ones are
        left out. If the total is known, a bar follows the first text.
    """
    return Progress(_Line(console, parts), console=console, transient=True, refresh_per_second=8)
