"""Processor and memory of processes, as time goes by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import NamedTuple

import psutil

__all__ = ["Sample", "Usage"]


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

    samples  of each name, oldest first
    """

    def __init__(self) -> None:
        self.samples: dict[str, list[Sample]] = {}
        self._busy: dict[int, float] = {}  # seconds of each process id
        self._moment: float | None = None

    def look(self, moment: float, pids: Mapping[str, Iterable[int]]) -> None:
        """Take a sample of each; the first look only says where they begin."""
        before, self._moment = self._moment, moment
        for name, numbers in pids.items():
            busy, memory = 0.0, 0
            for pid in numbers:
                with suppress(psutil.Error):  # it has just ended
                    process = psutil.Process(pid)
                    seconds = sum(process.cpu_times()[:2])
                    busy += seconds - self._busy.get(pid, 0.0)
                    self._busy[pid] = seconds
                    memory += process.memory_info().rss
            if before is not None and moment > before:
                self.samples.setdefault(name, []).append(Sample(moment, busy / (moment - before), memory))
