"""The control group of this process: how often the kernel has killed a process for lack of memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_GROUPS = Path("/proc/self/cgroup")  # a line for each hierarchy: number:controllers:path
_MOUNT = Path("/sys/fs/cgroup")


def oom_kills() -> int:
    """Processes that the kernel has killed in the control group of this process because memory ran out.

    The files are those of version 2 (`memory.events`) or 1 (`memory.oom_control`). 0 if neither can be read.
    """
    for file in _files():
        with suppress(OSError, StopIteration, ValueError):
            return next(int(line.split()[1]) for line in file.read_text().splitlines() if line.startswith("oom_kill "))
    return 0


def _files() -> Iterator[Path]:
    """The files that may have the count; in a container, the path of the group may be seen from the host only."""
    with suppress(OSError):
        for line in _GROUPS.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if "memory" in controllers.split(","):
                folder, name = _MOUNT / "memory", "memory.oom_control"
            elif not controllers:
                folder, name = _MOUNT, "memory.events"
            else:
                continue
            yield folder / path.lstrip("/") / name
            yield folder / name
