"""The options and the output of every benchmark: tables on the terminal and in a JSON file.

`--json benchmarks/results/NAME.json` is a record, of which `make results` writes the tables in the documentation.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from provenance import ROOT, provenance

from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.errors import CatstreamError

_DATA = Path(os.environ.get("TRACKING_DATA", "data"))
#: Options with paths of this machine.
_PLACES = ("--json", "--data", "--strips", "--models")

Cell = str | int | float | None


@dataclass(frozen=True, slots=True)
class Table:
    """A table of figures.

    title    measured quantity
    columns  headings, with units
    rows     one cell for each column; None for an empty cell
    note     explanation of the figures
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""


def command(about: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of sequences (default: $TRACKING_DATA, data)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures and their provenance to a file")
    parser.add_argument("--quick", action="store_true", help="a few rendered frames, to test that the benchmark runs")
    return parser


def benchmark(
    figures: Callable[[argparse.Namespace], Iterable[Table]],
    parser: argparse.ArgumentParser,
    settings: Callable[[argparse.Namespace], Settings] = lambda _: Settings(),
    **more: tuple[Any, str],
) -> None:
    """Read the options of a benchmark, and publish its figures.

    Parameters
    ----------
    figures : measures, and yields the tables
    parser : of `command`
    settings : those that hold for all tables
    more : further options by name: the default, or the type of an option without one, and what it means; a list has
        several values
    """
    for name, (default, meaning) in more.items():
        if default is False:
            parser.add_argument(f"--{name}", action="store_true", help=meaning)
        elif isinstance(default, type):
            parser.add_argument(f"--{name}", type=default, metavar=default.__name__.upper(), help=meaning)
        else:
            several = isinstance(default, list)
            kind = type(default[0] if several else default)
            text = f"{meaning} (default: %(default)s)".strip()
            parser.add_argument(f"--{name}", type=kind, nargs="+" if several else None, default=default, help=text)
    options = parser.parse_args()
    publish(figures(options), options, settings(options))


def publish(tables: Iterable[Table], options: argparse.Namespace, settings: Settings | None = None) -> None:
    """Print each table when it is ready, and write all to the file of `--json`; linear algebra runs on one core.

    Parameters
    ----------
    tables : what was measured
    options : of `command`; the figures in its attribute `record`, if `tables` sets it, are written beside the tables
    settings : those that hold for all tables, None for the defaults
    """
    shown = []
    try:
        with one_thread(opencv=True):
            for table in tables:
                print(table.title, text(table), sep="\n")
                print(table.note, end="\n\n" if table.note else "\n", flush=True)
                shown.append(asdict(table))
    except CatstreamError as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {error}")
    if options.json is not None:
        made = provenance((settings or Settings()).changed(), list(_words()))
        figures = {**made, **getattr(options, "record", {}), "tables": shown}
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def mean_and_error(values: Iterable[float | None]) -> tuple[float | None, float | None]:
    """Return the mean of the values that are not None, and its standard error, if there are enough."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None, stdev(known) / len(known) ** 0.5 if len(known) > 1 else None


def text(table: Table) -> str:
    """Format headings and rows in columns: words left-aligned, figures right-aligned.

    >>> print(text(Table("", ("tracker", "frames/s"), [("catstream", 101.4), ("csrt", None)])))
    tracker    frames/s
    catstream       101
    csrt              -
    """
    cells = [list(table.columns), *([_cell(cell) for cell in row] for row in table.rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    first = table.rows[0] if table.rows else table.columns
    lines = [
        "  ".join(
            f"{cell:<{width}}" if isinstance(kind, str) else f"{cell:>{width}}"
            for cell, width, kind in zip(row, widths, first, strict=True)
        ).rstrip()
        for row in cells
    ]
    return "\n".join(lines)


def _cell(cell: Cell) -> str:
    if isinstance(cell, float):
        return f"{cell:.{0 if abs(cell) >= 100 else 1 if abs(cell) >= 10 else 3}f}"
    return "-" if cell is None else str(cell)


def _words() -> Iterator[str]:
    """Return the command of this process as typed in the checkout, without the options in `_PLACES`."""
    program = Path(sys.argv[0]).resolve()
    yield from ("python", program.relative_to(ROOT).as_posix() if ROOT in program.parents else program.name)
    words: Iterator[Any] = iter(sys.argv[1:])
    for word in words:
        if word in _PLACES:
            next(words, None)
        elif not word.startswith(tuple(f"{option}=" for option in _PLACES)):
            yield word
