"""CSV tables that were written by this program, a spreadsheet or a data frame library.

The first line names the columns, in any order and case. Commas, semicolons or tabs separate them. Blanks around
values and empty rows are ignored. Numbers may have a decimal comma; 119.0 is a whole number.
"""

from __future__ import annotations

import csv
import io
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

from catstream.base.files import write_atomically, writing
from catstream.base.text import listed
from catstream.errors import CatstreamError, ServiceError, VideoError

_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True)
class Row:
    """The values of a row by column. A ValueError names the column of an invalid value."""

    values: dict[str, str]
    separator: str

    def text(self, column: str) -> str:
        """The text of a value, empty if the row has none."""
        return self.values.get(column, "")

    def number(self, column: str) -> float:
        """A finite number.

        >>> Row({"x": "40,5"}, ";").number("x")
        40.5
        """
        text = self.text(column)
        try:
            # Three digits after the comma of a table with commas may be thousands.
            is_decimal = text.count(",") == 1 and (self.separator != "," or len(text.partition(",")[2]) != 3)
            number = float(text.replace(",", ".") if is_decimal else text)
        except ValueError:
            number = float("nan")
        if not isfinite(number):
            raise ValueError(f"column {column}: expected a number, got {text!r}")
        return number

    def integer(self, column: str, default: int | None = None) -> int:
        """A whole number; the default for an empty value."""
        if default is not None and not self.text(column):
            return default
        if not (number := self.number(column)).is_integer():
            raise ValueError(f"column {column}: expected a whole number, got {self.text(column)!r}")
        return int(number)

    def choice(self, column: str, choices: Sequence[str]) -> Any:
        """The text of a value, one of the choices."""
        if (text := self.text(column)) not in choices:
            raise ValueError(f"column {column}: expected {' or '.join(filter(None, choices))}, got {text!r}")
        return text


class Columns:
    """The header of a table: the names of its columns, and their separator.

    start  number of lines up to and including the header
    """

    def __init__(self, path: Path, lines: Iterable[str], required: Sequence[str]) -> None:
        """Read the names from the first line that has any; VideoError if a required one is missing."""
        self.names, self.separator, self.start = list[str](), ",", 0
        for self.start, line in enumerate(lines, 1):
            self.separator = max(",;\t", key=line.count)
            self.names = [name.lower() for name in self._split(line)]
            if any(self.names) and not line.startswith("sep="):  # a line for Excel, before the names
                break
        if missing := [column for column in required if self.start and column not in self.names]:
            names = ",".join(required)
            raise VideoError(
                f"{path} lacks the column {listed(missing)}: its first line has to name the columns {names}"
            )

    def row(self, line: str, *, whole: bool = False) -> Row | None:
        """Read a line; None if it has no value. ValueError if a `whole` row has fewer values than columns."""
        values = self._split(line)
        if not any(values):
            return None
        if whole and len(values) < len(self.names):
            raise ValueError(f"{len(values)} values for {len(self.names)} columns")
        return Row(dict(zip(self.names, values, strict=False)), self.separator)

    def _split(self, line: str) -> list[str]:
        (values,) = csv.reader([line.strip("\r\n")], delimiter=self.separator, skipinitialspace=True)
        return [value.strip() for value in values]


def read_table(path: Path, required: Sequence[str], parse: Callable[[Row], _Value]) -> list[_Value]:
    """Parse the rows of a table; VideoError, with the line, if it cannot be read or `parse` raises a ValueError."""
    values, number = [], 1
    try:
        data = path.read_bytes()
        is_wide = data.startswith((BOM_UTF16_LE, BOM_UTF16_BE))  # "Unicode text" of Excel
        lines = io.StringIO(data.decode("utf-16" if is_wide else "utf-8-sig"), newline=None)
        columns = Columns(path, lines, required)
        for number, line in enumerate(lines, columns.start + 1):  # noqa: B007
            if (row := columns.row(line)) is not None:
                values.append(parse(row))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "its text is not UTF-8"
        raise VideoError(
            f"cannot read {str(path)!r} ({reason}): pass a CSV file with the columns {','.join(required)}"
        ) from None
    except ValueError as error:
        raise VideoError(f"{str(path)!r}, line {number}: {error}") from None
    return values


def write_table(
    path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]], kind: type[CatstreamError] = ServiceError
) -> None:
    """Write a table atomically, and make its folder; an error of this kind if it cannot be written."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    with writing(path, kind):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.getvalue().encode(errors="surrogateescape"))  # names of files need not be UTF-8
