"""Frames per second with 1, 2, 4 and 8 objects, in one process and in the pipeline's three, on a rendered video.

The same video of 640x480 pixels is tracked each time, with more or fewer of its objects. The runs alternate, so that
other load of the machine affects all alike: the ratios are more reliable than the rates.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Mapping
from statistics import median
from time import perf_counter, process_time

import numpy as np
from journey import travel
from sequences import scratch
from table import Cell, Table, benchmark, command

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.loadtest import crowd
from catstream.multi import MultiTracker
from catstream.video.source import open_source
from catstream.video.writer import VideoWriter

COUNTS = (1, 2, 4, 8)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    counts, frames, runs = ((1, 2), 8, 1) if options.quick else (COUNTS, options.frames, options.runs)
    path, starts = scratch() / "crowd.mp4", {}
    with VideoWriter(path, 25, crowd.SIZE) as video:
        for image, boxes in crowd.render(counts[-1], frames):
            video.write(image)
            starts = starts or {name: box for name, box in boxes.items() if box is not None}
    for title, measure in (("One process", in_one_process), ("Three processes", in_three_processes)):
        yield Table(
            f"Objects: {title.lower()}",
            ("objects", "ms a frame", "frames/s", "each further object, of the first", "processor, ms a frame"),
            list(rows(measure, str(path), starts, counts, runs)),
            f"640x480 pixels, {frames} frames with decoding, median of {runs} runs; {os.cpu_count()} cores",
        )


def rows(
    measure: Callable[[str, Mapping[str, Box]], tuple[float, float]],
    source: str,
    starts: Mapping[str, Box],
    counts: tuple[int, ...],
    runs: int,
) -> Iterator[tuple[Cell, ...]]:
    """Measure each number of objects in turn, some times; return a row for each."""
    found: dict[int, list[tuple[float, float]]] = {count: [] for count in counts}
    for _ in range(runs):
        for count in counts:
            found[count].append(measure(source, dict(list(starts.items())[:count])))
    first = median(seconds for seconds, _ in found[1])
    for count, each in found.items():
        seconds, processor = (median(values) for values in zip(*each, strict=True))
        further = None if count == 1 else (seconds - first) / (count - 1) / first
        yield count, seconds * 1000, 1 / seconds, further, processor * 1000


def in_one_process(source: str, boxes: Mapping[str, Box]) -> tuple[float, float]:
    """Seconds, and processor seconds, a frame after the first."""
    tracker, count = MultiTracker(), 0
    with open_source(source) as frames:
        for frame in frames:
            if not count:
                tracker.init(frame.image, boxes)
                begin, used = perf_counter(), process_time()
            else:
                tracker.update(frame.image)
            count += 1
    return (perf_counter() - begin) / (count - 1), (process_time() - used) / (count - 1)


def in_three_processes(source: str, boxes: Mapping[str, Box]) -> tuple[float, float]:
    """Seconds, and processor seconds of the three processes, a frame from the first track to the last."""
    journey = travel(source, boxes, Settings(), watch=20)
    work = [np.average(spent) for spent in (journey.work(name)[1] for name in journey.looks) if len(spent)]
    return 1 / journey.rate, sum(work) / 1000


if __name__ == "__main__":
    benchmark(figures, command(__doc__), frames=(200, "length of the video"), runs=(3, "number of runs of each"))
