"""Measures what a run writes to the disk: bytes per second and per frame, and their growth with the trees.

The kernel counts a page in `write_bytes` of /proc/PID/io when it becomes dirty, and in `cancelled_write_bytes` when its
file is removed before it was written back. The disk gets the difference. Logical bytes are those of write(2), `wchar`,
many of which fall on pages that are dirty already. The counts of a process that has ended are added to those of its
parent, so this process has those of the whole run at its end.

Measure on an idle machine: if a tenth of the memory is dirty (`vm.dirty_background_ratio`), the kernel writes back the
pages of all processes, and the disk gets every checkpoint.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import cv2
import numpy as np
from resume import TRACK, written
from table import Cell, Table, benchmark, command

from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.coreset.forest import Forest
from catstream.measure.camera import Camera, Schedule
from catstream.measure.load_result import Plan
from catstream.measure.load_video import prepare
from catstream.multi import MultiTracker
from catstream.processes.decisions import sync_interval
from catstream.processes.state import CHECKPOINTS

_MARKS = (1_000, 10_000, 25_000, 50_000, 100_000)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    columns = ("objects", "frames", "disk MB/s", "dirtied MB/s", "logical MB/s", "disk kB/frame", "checkpoint MB")
    seconds, numbers = (3.0, [1]) if options.quick else (float(options.seconds), options.objects)
    rows = [camera(number, seconds) for number in numbers] if seconds else []
    if rows:
        yield Table("A live camera", columns, rows, f"640x480, 25 frames/s, {seconds:g} s, with logs and checkpoints")
    columns = ("objects", "frames", "checkpoint MB", "disk kB/frame", "dirtied kB/frame", "logical kB/frame")
    marks = [50, 100] if options.quick else [mark for mark in _MARKS if mark <= options.frames]
    rows = [row for number in numbers for row in growth(number, marks)]
    yield Table("Growth", columns, rows, "checkpoints as at 25 frames/s, without logs; per frame since the row before")


def camera(objects: int, seconds: float) -> tuple[Cell, ...]:
    """Track objects of a live source with --output and --state, and return a row of figures."""
    plan = Plan(objects=objects, size=(640, 480), duration=min(seconds, 48))
    video = prepare(plan, plan.frames, lambda *_: None)
    boxes = [word for name, box in video.boxes.items() for word in ("--box", f"{name or 'object'}={box}")]
    with TemporaryDirectory(prefix="catstream-writes-") as place, Camera("mjpeg", plan.size, video.units) as source:
        state, out = Path(place, "state"), Path(place, "out")
        before = counts()
        run = subprocess.Popen([*TRACK, source.urls[0], *boxes, "--state", state, "--output", out])
        while not written(out) and run.poll() is None:
            time.sleep(0.1)
        source.play(Schedule(time.monotonic(), plan.rate))
        time.sleep(seconds)
        run.send_signal(signal.SIGTERM)
        run.wait()
        dirtied, cancelled, logical = counts() - before
        frames, newest = written(out) // objects, max((state / CHECKPOINTS).glob("[0-9]*"))
        disk = dirtied - cancelled
        rates = [figure / seconds / 1e6 for figure in (disk, dirtied, logical)]
        return objects, frames, *rates, disk / frames / 1e3, newest.stat().st_size / 1e6


def growth(objects: int, marks: list[int]) -> Iterator[tuple[Cell, ...]]:
    """Insert the features of a video again and again, save checkpoints as a compressor does, and yield rows of figures.

    A second has 25 frames, however long they take.
    """
    tracker, plan = MultiTracker(), Plan(objects=objects, size=(640, 480), duration=min(marks[-1] / 25, 10))
    video = prepare(plan, plan.frames, lambda *_: None)
    with patch.object(Forest, "take", autospec=True, side_effect=Forest.take) as take:
        for number, unit in enumerate(video.units):
            image = cv2.imdecode(np.frombuffer(unit, np.uint8), cv2.IMREAD_COLOR)
            tracker.update(image) if number else tracker.init(image, video.boxes)
    features, interval = cycle(call.args[1] for call in take.mock_calls[1:]), tracker.settings.run.checkpoint_seconds
    forest, first, last, sync_at, before = tracker.forest, tracker.forest.frame, 0, 0.0, counts()
    with TemporaryDirectory(prefix="catstream-writes-") as place:
        store = CheckpointStore(place)
        for number in range(1, marks[-1] + 1):
            forest.take(replace(next(features), frame=first + number))
            second = number / plan.rate
            if number % (interval * plan.rate) == 0:
                store.save(forest, durable=second >= sync_at)
                sync_at = second + sync_interval(store.size) if second >= sync_at else sync_at
            if number in marks:
                dirtied, cancelled, logical = (counts() - before) / (number - last) / 1e3
                yield objects, number, store.size / 1e6, dirtied - cancelled, dirtied, logical
                last, before = number, counts()


def counts() -> np.ndarray:
    """Return dirtied, cancelled and logical bytes of this process and of its children that have ended."""
    lines = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return np.array([int(lines[name]) for name in ("write_bytes", "cancelled_write_bytes", "wchar")])


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        seconds=(600, "duration of the live runs"),
        frames=(100_000, "frames of the growth"),
        objects=([1, 8], "numbers of objects"),
    )
