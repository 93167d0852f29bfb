"""Runs the real pipeline of three processes, and measures time and memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple

import numpy as np
import psutil

from catstream.base.names import Boxes
from catstream.base.settings import Settings
from catstream.pipeline import Pipeline
from catstream.video.source import ALL_FRAMES
from catstream.wire.messages import Track


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
