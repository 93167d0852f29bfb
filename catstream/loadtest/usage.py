"""Processor and memory of processes, as time goes by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import psutil

__all__ = ["REST", "Usage", "UsageReading", "summary"]

#: What is not ours on this machine: where it is busy, no figure is worth much.
REST = "everything else"


class UsageReading(NamedTuple):
    """What a process took since the reading before.

    moment  by `time.monotonic`
    cores   of the processor: 1.0 is one of them, all the time
    memory  resident, in bytes
    """

    moment: float
    cores: float
    memory: int


class Usage:
    """Samples of named processes; a name may stand for several, and for another one after a restart.

    readings  of each name, oldest first, and of `REST`
    """

    def __init__(self) -> None:
        self.readings: dict[str, list[UsageReading]] = {}
        self._cpu_seconds: dict[int, float] = {}  # seconds of each process id
        self._moment: float | None = None

    def read(self, moment: float, pids: Mapping[str, Iterable[int]]) -> None:
        """Take a reading of each; the first read only says where they begin."""
        before, self._moment = self._moment, moment
        # In percent of all cores, since the call before.
        cores, memory = psutil.cpu_percent() / 100 * psutil.cpu_count(), psutil.virtual_memory().used
        for name, numbers in pids.items():
            busy, resident = 0.0, 0
            for pid in numbers:
                with suppress(psutil.Error):  # it has just ended
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
    """Of one process: mean and most of its processor in cores, and of its memory in bytes."""
    cores, memory = [reading.cores for reading in readings], [reading.memory for reading in readings]
    return {
        "cores": sum(cores) / len(cores),
        "cores_most": max(cores),
        "memory": sum(memory) / len(memory),
        "memory_most": max(memory),
    }
