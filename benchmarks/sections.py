"""The parts of a page of results: sections of tables from the records in `benchmarks/results`, with a few sentences."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

from table import Table, text

RECORDS = Path(__file__).parent / "results"
DOCS = Path(__file__).parents[1] / "docs"

Record = Mapping[str, Any]


class Shown(NamedTuple):
    """A record on the page: its file in `benchmarks/results`, and the tables made from it."""

    record: str
    tables: Callable[[Record], Iterable[Table]]


class Section(NamedTuple):
    """A part of the page: its heading, an introduction to its tables, and the tables."""

    heading: str
    introduction: str | Callable[[Mapping[str, Record]], str]
    parts: tuple[Shown, ...]


class Page(NamedTuple):
    """A page of results: its file, its title, an introduction, and the sections."""

    path: Path
    title: str
    introduction: str
    sections: tuple[Section, ...]


def records() -> dict[str, Record]:
    """Return all records by name."""
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(RECORDS.glob("*.json"))}


def written(page: Page, found: Mapping[str, Record]) -> str:
    """Return the text of a page."""
    parts = [f"# {page.title}", filled(page.introduction)]
    for section in page.sections:
        blocks = [_block(found[name], tables) for name, tables in section.parts]
        introduction = section.introduction if isinstance(section.introduction, str) else section.introduction(found)
        parts += [f"## {section.heading}", filled(introduction)]
        parts += ["```console\n" + "\n".join(blocks) + "\n```"] if blocks else []
    return "\n\n".join(parts) + "\n"


def _block(record: Record, tables: Callable[[Record], Iterable[Table]]) -> str:
    machine = record["machine"]
    made = f"{record['date']}, commit {record['commit']}, {machine['cores']} cores of {machine['processor']}"
    settings = f", {len(record['settings'])} settings differ from the defaults" if record["settings"] else ""
    return f"$ {record['command']}  # {made}{settings}\n" + "\n\n".join(map(text, tables(record)))


def select(number: int = 0, *, columns: Sequence[str] = (), without: str = "") -> Callable[[Record], Iterator[Table]]:
    """Return a function that selects table `number` of a record, with these columns, without the rows of a pattern."""

    def chosen(record: Record) -> Iterator[Table]:
        table = record["tables"][number]
        places = [table["columns"].index(column) for column in columns or table["columns"]]
        kept = [row for row in table["rows"] if not (without and re.match(without, " ".join(map(str, row))))]
        yield Table(
            "", [table["columns"][place] for place in places], [[row[place] for place in places] for row in kept]
        )

    return chosen


def every(record: Record) -> Iterator[Table]:
    """Select all tables of a record."""
    for number in range(len(record["tables"])):
        yield from select(number)(record)


def filled(paragraphs: str) -> str:
    """Return paragraphs, which blank lines separate, in lines of at most 120 characters."""
    return "\n\n".join(
        fill(
            " ".join(paragraph.split()),
            120,
            subsequent_indent="  " if paragraph.lstrip().startswith("- ") else "",
            break_long_words=False,
            break_on_hyphens=False,
        )
        for paragraph in re.split(r"\n\s*\n", paragraphs.strip())
    )
