"""Kills, stops and continues all processes of one node of a local fleet at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from catstream.errors import FleetError
from catstream.fleet.keeper import holder
from catstream.fleet.local import LocalFleet

__all__ = ["freeze_node", "kill_node", "processes", "thaw_node"]


def kill_node(fleet: LocalFleet, name: str) -> None:
    """Kill all processes of the node `name`, or of the `head`: keeper, Ray, actors and pipelines."""
    freeze_node(fleet, name)  # none of them can start another process, or end in order
    for pid in processes(fleet, name):
        _signal(pid, signal.SIGKILL)


def freeze_node(fleet: LocalFleet, name: str) -> None:
    """Stop all processes of a node, as if its machine hung. Sockets stay open, nothing answers."""
    frozen: set[int] = set()
    while found := set(processes(fleet, name)) - frozen:  # until no new process appears
        for pid in found:
            _signal(pid, signal.SIGSTOP)
        frozen |= found


def thaw_node(fleet: LocalFleet, name: str) -> None:
    """Let the processes of a frozen node go on."""
    for pid in processes(fleet, name):
        _signal(pid, signal.SIGCONT)


def processes(fleet: LocalFleet, name: str) -> list[int]:
    """Process ids of a node, its keeper first."""
    keeper = holder(name, fleet.folder)
    if keeper is None:
        raise FleetError(f"{name} does not run in {fleet.folder}: there are {', '.join(fleet.names) or 'no nodes'}")
    return [keeper, *_descendants(keeper)]


def _descendants(pid: int) -> Iterator[int]:
    with suppress(OSError):  # it has ended
        for thread in Path(f"/proc/{pid}/task").iterdir():
            for child in map(int, (thread / "children").read_text().split()):
                yield child
                yield from _descendants(child)


def _signal(pid: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)
