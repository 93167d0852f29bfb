"""The log of a process that this one has started: a file that the process writes to, and this one reads."""

from __future__ import annotations

import os
from typing import BinaryIO

_LAST_LINE = 2000  # bytes at the end of the log in which the last line is searched for
_STEP = 65536  # bytes of the log that are read at once


class ProcessLog:
    """A log whose lines begin with the name of the process.

    Parameters
    ----------
    name : name of the process
    file : open for reading and writing; the process gets its descriptor as standard error
    """

    def __init__(self, name: str, file: BinaryIO) -> None:
        self._mark, self._file = f"{name}: ", file
        self._read = 0  # bytes that `new_lines` has returned

    def fileno(self) -> int:
        """The descriptor of the file."""
        return self._file.fileno()

    def new_lines(self) -> list[str]:
        """The lines that the process logged since the last call, without the output of Python itself."""
        # The process writes at the position of the file, which `pread` leaves alone.
        whole, end, _ = os.pread(self.fileno(), _STEP, self._read).rpartition(b"\n")
        self._read += len(whole) + len(end)
        lines = whole.decode(errors="replace").splitlines()
        return [line.removeprefix(self._mark) for line in lines if line.startswith(self._mark)]

    def last_line(self) -> str:
        """The last line that was logged."""
        size = os.fstat(self.fileno()).st_size
        text = os.pread(self.fileno(), _LAST_LINE, max(0, size - _LAST_LINE))
        lines = text.decode(errors="replace").strip().splitlines()
        return lines[-1].removeprefix(self._mark) if lines else "it logged nothing"

    def close(self) -> None:
        """Close the file."""
        self._file.close()
