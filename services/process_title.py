"""The title of a process, which `ps`, `top` and `pgrep` show in place of its command; and its state in the kernel."""

from __future__ import annotations

import ctypes
import os
import signal
from contextlib import suppress
from pathlib import Path

_SET_NAME = 15  # PR_SET_NAME
#: Fields of /proc/PID/stat: the state, the flags, the signals that wait, and the addresses of the command's arguments.
_STATE, _FLAGS, _SIGNALS, _ARGUMENTS = 3, 9, 31, slice(48, 50)
_EXITING = 0x4  # PF_EXITING, one of the flags
_KILLED = 1 << signal.SIGKILL - 1  # one of the signals that wait, until the process runs for the last time


def process_fields(pid: int) -> list[str]:
    """The fields of /proc/PID/stat by their numbers in `man proc`; those before the state are empty.

    Raises
    ------
    OSError
        If the process has ended.
    """
    # The second field is the name of the program, which may contain spaces.
    return ["", "", "", *Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()]


def is_suspended(pid: int) -> bool:
    """Whether a signal such as SIGSTOP has stopped a process."""
    with suppress(OSError):  # it has ended
        return process_fields(pid)[_STATE] == "T"
    return False


def is_ending(pid: int) -> bool:
    """Return whether a process has ended, or was killed: its sockets may be open a little longer."""
    try:
        fields = process_fields(pid)
        return bool(int(fields[_FLAGS]) & _EXITING or int(fields[_SIGNALS]) & _KILLED)
    except OSError:  # it has ended
        return True


def set_process_title(name: str) -> None:
    """Show this process as `catstream NAME`, and by NAME where only 15 characters are shown.

    The memory of the command's arguments is overwritten, as the kernel reads the title from there. On a system without
    /proc the title stays as it is.
    """
    ctypes.CDLL(None).prctl(_SET_NAME, name.encode(), 0, 0, 0)
    with suppress(OSError, ValueError):
        begin, end = map(int, process_fields(os.getpid())[_ARGUMENTS])
        title = f"catstream {name}".encode()[: max(end - begin - 2, 0)]
        # If the last byte is not 0, the kernel takes the memory for a title, and shows it up to the first 0.
        ctypes.memmove(begin, title.ljust(end - begin - 1, b"\0") + b".", end - begin)
