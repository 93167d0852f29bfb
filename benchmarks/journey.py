"""A run of the real pipeline, three processes and all, watched from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np
import psutil

from catstream.pipeline import Pipeline
from catstream.settings import Settings

__all__ = ["Journey", "draw", "travel"]


@dataclass(slots=True)
class Journey:
    """What was seen of one run.

    boxes    a row a frame, x, y, w, h in pixels; NaN where absent
    moments  seconds from the start to the track of each frame
    memory   of each process: (frame, resident megabytes), now and then
    """

    boxes: list[Sequence[float]] = field(default_factory=list)
    moments: list[float] = field(default_factory=list)
    memory: dict[str, list[tuple[int, float]]] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Frames a second from the first track to the last, decoding included."""
        return (len(self.moments) - 1) / (self.moments[-1] - self.moments[0])

    @property
    def milliseconds(self) -> np.ndarray:
        """Between each track and the one before it, float64 (frames - 1,)."""
        return np.diff(self.moments) * 1000


def travel(source: str, box: Sequence[float], settings: Settings, watch: int = 250) -> Journey:
    """Run a pipeline to the end of its source; look at the processes' memory each `watch` frames."""
    journey, begin = Journey(), perf_counter()
    with Pipeline(source, box, settings) as pipeline:
        for track in pipeline:
            journey.moments.append(perf_counter() - begin)
            journey.boxes.append(track.box or (np.nan,) * 4)
            if track.frame % watch == 0:
                for name, pid in pipeline.pids.items():
                    if megabytes := resident(pid):
                        journey.memory.setdefault(name, []).append((track.frame, megabytes))
    return journey


def resident(pid: int) -> float:
    """Megabytes of a process; 0 where it has just ended."""
    try:
        return psutil.Process(pid).memory_info().rss / 1e6
    except psutil.Error:
        return 0.0


def draw(journeys: dict[str, Journey], file: Path, blocks: int = 80) -> None:
    """Plot time a frame, the median of each block of frames, and memory against frames, one above the other."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, (time, memory) = pyplot.subplots(2, 1, sharex=True, figsize=(8, 6), layout="constrained")
    for label, journey in journeys.items():
        parts = np.array_split(journey.milliseconds, blocks)
        time.plot(np.cumsum([len(part) for part in parts]), [np.median(part) for part in parts], label=label)
        for name, seen in journey.memory.items():
            memory.plot(*zip(*seen, strict=True), label=f"{label} {name}".strip())
    time.set(ylabel="ms a frame (median)", ylim=(0, None))
    memory.set(ylabel="resident memory, MB", xlabel="frame", ylim=(0, None))
    if len(journeys) > 1:
        time.legend()
    memory.legend(fontsize="small")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)
    pyplot.close(figure)
