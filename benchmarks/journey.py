"""Runs the real pipeline of three processes, and measures time and memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
import psutil
from table import plots

from catstream.base.names import Boxes
from catstream.base.settings import Settings
from catstream.messages.kinds import Track
from catstream.pipeline import Pipeline
from catstream.video.source import ALL_FRAMES


class Look(NamedTuple):
    """Resident memory in megabytes and processor time in seconds of a process at one moment."""

    frame: int
    megabytes: float
    seconds: float


@dataclass(slots=True)
class Journey:
    """The measurements of one run.

    boxes    of the first object, a row a frame, x, y, w, h in pixels; NaN where absent
    moments  seconds from the start to the track of each frame
    looks    at each process, now and then
    """

    boxes: list[Sequence[float]] = field(default_factory=list)
    moments: list[float] = field(default_factory=list)
    looks: dict[str, list[Look]] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Frames per second from the first track to the last, including decoding."""
        return (len(self.moments) - 1) / (self.moments[-1] - self.moments[0])

    @property
    def milliseconds(self) -> np.ndarray:
        """Seconds between consecutive tracks, float64 (frames - 1,)."""
        return np.diff(self.moments) * 1000

    def work(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Frames, and milliseconds of a processor that a process took for each since the look before.

        Other work on the machine hardly changes it, as it does the time between tracks.
        """
        frames, _, seconds = np.array(self.looks[name], float).T
        return frames[1:], np.diff(seconds) / np.diff(frames) * 1000


def travel(
    source: str,
    boxes: Boxes,
    settings: Settings,
    watch: int = 250,
    part: slice = ALL_FRAMES,
    turn: Callable[[Mapping[str, Track]], None] = lambda _: None,
) -> Journey:
    """Run a pipeline over its source or a part of it; measure the processes every `watch` frames.

    turn : called with the tracks of each frame
    """
    journey, begin = Journey(), perf_counter()
    with Pipeline(source, boxes, settings, part=part) as pipeline:
        for number, tracks in enumerate(pipeline.by_frame()):
            journey.moments.append(perf_counter() - begin)
            journey.boxes.append(next(iter(tracks.values())).box or (np.nan,) * 4)
            turn(tracks)
            if number % watch == 0:
                for name, pid in pipeline.pids.items():
                    with suppress(psutil.Error):  # the process has just ended
                        process = psutil.Process(pid)
                        seconds = sum(process.cpu_times()[:2])
                        look = Look(number, process.memory_info().rss / 1e6, seconds)
                        journey.looks.setdefault(name, []).append(look)
    return journey


def draw(journeys: dict[str, Journey], file: Path, blocks: int = 80) -> None:
    """Plot against frames: median time per frame in blocks, processor time of each process per frame, and memory."""
    with plots(file, (8, 8), rows=3) as (time, work, memory):
        for label, journey in journeys.items():
            parts = np.array_split(journey.milliseconds, min(blocks, len(journey.milliseconds)))
            time.plot(np.cumsum([len(part) for part in parts]), [np.median(part) for part in parts], label=label)
            for name, looks in journey.looks.items():
                work.plot(*journey.work(name), label=f"{label} {name}".strip())
                memory.plot([look.frame for look in looks], [look.megabytes for look in looks])
        time.set(ylabel="ms a frame (median)", ylim=(0, None))
        work.set(ylabel="processor time, ms a frame", ylim=(0, None))
        memory.set(ylabel="resident memory, MB", xlabel="frame", ylim=(0, None))
        if len(journeys) > 1:
            time.legend()
        work.legend(fontsize="small")
