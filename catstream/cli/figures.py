"""Writes the figures of a command to the JSON file that `--json` names."""

from __future__ import annotations

import json
from pathlib import Path

from catstream.errors import CatstreamError

__all__ = ["check_json", "write_json"]


def check_json(file: Path | None) -> None:
    """Check before the work that the file can be written.

    Raises
    ------
    CatstreamError
        If it is a folder, or its folder does not exist.
    """
    if file is not None and (file.is_dir() or not file.absolute().parent.is_dir()):
        problem = "it is a folder" if file.is_dir() else "its folder does not exist, make it first"
        raise CatstreamError(f"cannot write {str(file)!r}: {problem}")


def write_json(file: Path | None, figures: dict[str, object]) -> None:
    """Write figures to a file, if one is given.

    Raises
    ------
    CatstreamError
        If it cannot be written.
    """
    if file is not None:
        try:
            file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise CatstreamError(f"cannot write {str(file)!r}: {error.strerror}") from None
