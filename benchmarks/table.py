"""What every benchmark takes and gives: a few options in, tables on the terminal and in a JSON file out."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import cv2
from rich.console import Console
from rich.table import Table as Printed

from catstream.errors import CatstreamError
from catstream.threads import one_thread

__all__ = ["Table", "command", "publish"]

_DATA = Path(os.environ.get("TRACKING_DATA") or Path(__file__).parents[2] / "shared" / "data")
_LIBRARIES = ("catstream", "numpy", "numba", "scikit-learn", "pyzmq")

Cell = str | int | float | None


@dataclass(frozen=True, slots=True)
class Table:
    """Figures that belong together.

    title    what was measured
    columns  headings, with their unit
    rows     a cell a column; None where there is nothing to say
    note     what has to be known to read them
    """

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Cell, ...]]
    note: str = ""


def command(about: str | None) -> argparse.ArgumentParser:
    """The options that all benchmarks share."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of annotated sequences (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    parser.add_argument("--quick", action="store_true", help="a few rendered frames: shows that it runs, nothing else")
    return parser


def publish(tables: Iterable[Table], file: Path | None) -> None:
    """Print each table as it comes, and write all to a JSON file; linear algebra runs on one core meanwhile."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    shown = []
    try:
        with one_thread(opencv=True):
            for table in tables:
                console.print(f"[bold]{table.title}[/]", _printed(table), sep="\n")
                console.print(table.note, "", sep="\n", style="dim", markup=False, soft_wrap=True)
                shown.append(asdict(table))
    except CatstreamError as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {error}")
    if file is not None:
        figures = {"benchmark": Path(sys.argv[0]).stem, "machine": _machine(), "tables": shown}
        file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def _printed(table: Table) -> Printed:
    printed = Printed(box=None, header_style="italic", pad_edge=False)
    for column, cell in zip(table.columns, table.rows[0] if table.rows else table.columns, strict=True):
        printed.add_column(column, justify="left" if isinstance(cell, str) else "right")
    for row in table.rows:
        printed.add_row(*map(_text, row))
    return printed


def _text(cell: Cell) -> str:
    if isinstance(cell, float):
        return f"{cell:.{0 if abs(cell) >= 100 else 1 if abs(cell) >= 10 else 3}f}"
    return "-" if cell is None else str(cell)


def _machine() -> dict[str, object]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "opencv": cv2.__version__,  # which may be of another package, with more in it
        **{library: version(library) for library in _LIBRARIES},
    }
