"""Processor and memory use of processes over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import psutil

__all__ = ["REST", "Usage", "UsageReading", "summary"]

#: Name of the load by other processes of this machine. If it is high, the figures of a load test are unreliable.
REST = "everything else"


class UsageReading(NamedTuple):
    """Processor and memory use of a process since the previous reading.

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
        self._cpu_seconds: dict[int, float] = {}  # processor time by process id
        self._moment: float | None = None

    def read(self, moment: float, pids: Mapping[str, Iterable[int]]) -> None:
        """Add a reading of each group; the first call only initialises the processor times."""
        before, self._moment = self._moment, moment
        # psutil gives the percentage of all cores since its previous call.
        cores, memory = psutil.cpu_percent() / 100 * psutil.cpu_count(), psutil.virtual_memory().used
        for name, numbers in pids.items():
            busy, resident = 0.0, 0
            for pid in numbers:
                with suppress(psutil.Error):  # the process has just ended
                    process = psutil.Process(pid)
                    seconds = sum(process.cpu_times()[:2])
                    busy += seconds - self._cpu_seconds.get(pid, 0.0)
                    self._cpu_seconds[pid] = seconds
                    resident += process.memory_info().rss
            if before is not None and moment > before:
                reading = UsageReading(moment, busy / (moment - before), resident)
                self.readings.setdefault(name, []).append(reading)
                cores, memory = cores - reading.cores, memory - resident
        if before is not None and moment > before:
            self.readings.setdefault(REST, []).append(UsageReading(moment, max(0.0, cores), max(0, memory)))


def summary(readings: Sequence[UsageReading]) -> dict[str, float]:
    """Return mean and maximum of busy cores and of memory in bytes."""
    cores, memory = [reading.cores for reading in readings], [reading.memory for reading in readings]
    return {
        "cores": sum(cores) / len(cores),
        "cores_most": max(cores),
        "memory": sum(memory) / len(memory),
        "memory_most": max(memory),
    }
