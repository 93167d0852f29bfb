"""Processor and memory use of processes over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from typing import NamedTuple

import psutil

#: Name of the load by other processes of this machine. If it is high, the figures of a load test are unreliable.
REST = "everything else"


class UsageReading(NamedTuple):
    """Processor and memory use of a group of processes since the previous reading.

    moment  time of the reading by `time.monotonic`
    cores   mean number of busy cores
    memory  resident memory in bytes
    """

    moment: float
    cores: float
    memory: int


class Usage:
    """Readings of named groups of processes; after a restart, the process ids of a group may change.

    readings  readings by name, oldest first, and those of `REST`
    """

    def __init__(self) -> None:
        self.readings: dict[str, list[UsageReading]] = {}
        self._processes: dict[int, psutil.Process] = {}  # psutil keeps the processor time of the previous reading in it

    def read(self, moment: float, groups: Mapping[str, Iterable[int]]) -> None:
        """Add a reading of groups of process ids; the first call only starts the measurement."""
        is_first = not self._processes
        cores, memory = psutil.cpu_percent() / 100 * (psutil.cpu_count() or 1), psutil.virtual_memory().used
        for name, pids in groups.items():
            used = [self._of(pid) for pid in pids]
            reading = UsageReading(moment, sum(busy for busy, _ in used), sum(resident for _, resident in used))
            cores, memory = cores - reading.cores, memory - reading.memory
            if not is_first:
                self.readings.setdefault(name, []).append(reading)
        if not is_first:
            self.readings.setdefault(REST, []).append(UsageReading(moment, max(0.0, cores), max(0, memory)))

    def _of(self, pid: int) -> tuple[float, int]:
        """Return busy cores and memory of a process; nothing if it has just ended."""
        try:
            process = self._processes.get(pid) or psutil.Process(pid)
            self._processes[pid] = process
            return process.cpu_percent() / 100, process.memory_info().rss
        except psutil.Error:
            return 0.0, 0


def summary(readings: Sequence[UsageReading]) -> dict[str, float]:
    """Return mean and maximum of busy cores and of memory in bytes."""
    _, cores, memory = zip(*readings, strict=True)
    return {
        "cores": fmean(cores),
        "cores_most": max(cores),
        "memory": fmean(memory),
        "memory_most": max(memory),
    }
