"""Processor and memory of processes, as time goes by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import psutil

__all__ = ["REST", "Sample", "Usage", "summary"]

#: What is not ours on this machine: where it is busy, no figure is worth much.
REST = "everything else"


class Sample(NamedTuple):
    """What a process took since the sample before.

    moment  by `time.monotonic`
    cores   of the processor: 1.0 is one of them, all the time
    memory  resident, in bytes
    """

    moment: float
    cores: float
    memory: int


class Usage:
    """Samples of named processes; a name may stand for several, and for another one after a restart.

    samples  of each name, oldest first, and of `REST`
    """

    def __init__(self) -> None:
        self.samples: dict[str, list[Sample]] = {}
        self._busy: dict[int, float] = {}  # seconds of each process id
        self._moment: float | None = None

    def look(self, moment: float, pids: Mapping[str, Iterable[int]]) -> None:
        """Take a sample of each; the first look only says where they begin."""
        before, self._moment = self._moment, moment
        # In percent of all cores, since the call before.
        cores, memory = psutil.cpu_percent() / 100 * psutil.cpu_count(), psutil.virtual_memory().used
        for name, numbers in pids.items():
            busy, resident = 0.0, 0
            for pid in numbers:
                with suppress(psutil.Error):  # it has just ended
                    process = psutil.Process(pid)
                    seconds = sum(process.cpu_times()[:2])
                    busy += seconds - self._busy.get(pid, 0.0)
                    self._busy[pid] = seconds
                    resident += process.memory_info().rss
            if before is not None and moment > before:
                sample = Sample(moment, busy / (moment - before), resident)
                self.samples.setdefault(name, []).append(sample)
                cores, memory = cores - sample.cores, memory - resident
        if before is not None and moment > before:
            self.samples.setdefault(REST, []).append(Sample(moment, max(0.0, cores), max(0, memory)))


def summary(samples: Sequence[Sample]) -> dict[str, float]:
    """Of one process: mean and most of its processor in cores, and of its memory in bytes."""
    cores, memory = [sample.cores for sample in samples], [sample.memory for sample in samples]
    return {
        "cores": sum(cores) / len(cores),
        "cores_most": max(cores),
        "memory": sum(memory) / len(memory),
        "memory_most": max(memory),
    }
