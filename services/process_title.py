"""The title of a process: what `ps`, `top` and `pgrep` show in place of its command."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

__all__ = ["set_process_title"]

_SET_NAME = 15  # PR_SET_NAME
_ARGUMENTS = slice(47, 49)  # fields of /proc/self/stat: the first and the last address of the command's arguments


def set_process_title(name: str) -> None:
    """Show this process as `catstream NAME`, and by NAME where only 15 characters are shown.

    The memory of the command's arguments is overwritten, as the kernel reads the title from there. On a system without
    /proc the title stays as it is.
    """
    ctypes.CDLL(None).prctl(_SET_NAME, name.encode(), 0, 0, 0)
    with suppress(OSError, ValueError):
        # The second field is the name of the program, which may contain spaces.
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        begin, end = (int(field) for field in fields[_ARGUMENTS.start - 2 : _ARGUMENTS.stop - 2])
        title = f"catstream {name}".encode()[: max(end - begin - 2, 0)]
        # If the last byte is not 0, the kernel takes the memory for a title, and shows it up to the first 0.
        ctypes.memmove(begin, title.ljust(end - begin - 1, b"\0") + b".", end - begin)
