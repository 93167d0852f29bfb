"""The cost of subscribers: frames per second with many subscribers, some of them frozen, and with none.

All runs follow the same rendered video. The readers run where a core is idle: what is measured is the
pipeline, not what readers do with a track.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator, Mapping
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import NamedTuple

from journey import Journey, travel
from sequences import rendered
from table import Table, benchmark, command

import catstream
from catstream.base.settings import Settings
from catstream.client.address import Address
from catstream.errors import SilenceError
from catstream.loadtest.load import Subscribers
from catstream.messages.kinds import Track

SIZE = (320, 240)
PAUSE_SECONDS = 2.0  # between two late joiners


class Run(NamedTuple):
    """The measurements of one run.

    journey   of the pipeline
    joined    seconds until each late joiner had the last model
    frozen    seconds for which the frozen readers were that
    received  tracks that each other reader received
    """

    journey: Journey
    joined: list[float]
    frozen: float
    received: list[int]


def figures(options: argparse.Namespace) -> Iterator[Table]:
    frames, readers, frozen, runs = options.frames, options.readers, options.frozen, options.runs
    if options.quick:
        frames, readers, frozen, runs = 40, 2, 1, 1
    alone, beside = [], []
    for _ in range(runs):  # alternating, so that other load of the machine affects both alike
        alone.append(run_with(frames, 0, 0))
        beside.append(run_with(frames, readers, frozen))

    columns = ("subscribers", "frozen", "for s", "frames", "frames/s", "slowest run", "ratio")
    base, rows = median(run.journey.rate for run in alone), []
    for all_runs, connected, stopped in ((alone, 0, 0), (beside, readers, frozen)):
        rate, seconds = median(run.journey.rate for run in all_runs), median(run.frozen for run in all_runs)
        rows.append((connected, stopped, seconds, frames, rate, min(run.journey.rate for run in all_runs), rate / base))
    yield Table("Frames a second", columns, rows, f"median of {runs} runs each, made in turn")

    columns = ("subscribers", "process", "MB at a quarter", "MB at the end", "most", "CPU ms a frame")
    rows = [
        (connected, name, seen[len(seen) // 4], seen[-1], max(seen), 1000 * looks[-1].seconds / frames)
        for connected, run in ((0, alone[-1]), (readers, beside[-1]))
        for name, looks in run.journey.looks.items()
        for seen in [[look.megabytes for look in looks]]
    ]
    yield Table("Processes", columns, rows, "of the last runs; the coreset trees grow with the logarithm of the frames")

    joined = [1000 * seconds for run in beside for seconds in run.joined]
    columns = ("late joiners", "median ms", "longest ms")
    rows = [(len(joined), median(joined) if joined else None, max(joined, default=None))]
    yield Table("Until a late joiner has the last model", columns, rows, "its sockets included")

    received = [count for run in beside for count in run.received]
    columns = ("readers", "frames", "median", "least")
    rows = [(len(received), frames, median(received), min(received))]
    yield Table(
        "Tracks received by readers that were not frozen", columns, rows, "they attach while the first frames pass"
    )


def run_with(frames: int, readers: int, frozen: int) -> Run:
    """Run a pipeline over the whole video, with subscribers that connect at its start."""
    sequence, joined, ended = rendered(frames, SIZE), list[float](), threading.Event()
    with (
        TemporaryDirectory(prefix="catstream-") as folder,
        Subscribers(Address(folder), readers, frozen=frozen) as group,
    ):
        late = threading.Thread(target=join, args=(folder, ended, joined))

        def turn(tracks: Mapping[str, Track]) -> None:
            group.freeze()
            if readers and late.ident is None and any(track.model_version for track in tracks.values()):
                late.start()

        settings = Settings(run={"endpoint": folder})
        try:
            journey = travel(str(sequence.path), sequence.boxes[0], settings, frames // 50 + 1, turn=turn)
        finally:
            ended.set()
            if late.ident is not None:
                late.join()
        group.wait()
        return Run(journey, joined, group.frozen_seconds, group.received())


def join(endpoint: str, ended: threading.Event, seconds: list[float]) -> None:
    """Subscribe to the models repeatedly, and measure the time until the last model arrives."""
    while not ended.is_set():
        begin = perf_counter()
        try:
            with catstream.subscribe(endpoint, "models", timeout=10) as models:
                if next(models, None) is not None:
                    seconds.append(perf_counter() - begin)
        except SilenceError:
            if not ended.is_set():  # otherwise it connected after the end message
                raise
        ended.wait(PAUSE_SECONDS)


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        frames=(4_000, "frames of each run"),
        readers=(200, "number of subscribers"),
        frozen=(20, "number of those that are frozen"),
        runs=(2, "number of runs with and without subscribers"),
    )
