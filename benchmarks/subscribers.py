"""The cost of subscribers: frames per second with many subscribers, some of them frozen, and with none.

All runs follow the same rendered video. The readers run where a core is idle: what is measured is the
pipeline, not what readers do with a track.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from statistics import median
from time import perf_counter

import psutil
from sequences import rendered, video
from table import Table, command, publish

import catstream
from catstream.applications.loadtest.subscribers import Subscribers
from catstream.errors import SilenceError
from catstream.pipeline import Pipeline
from catstream.settings import Settings
from catstream.wire.endpoint import private_folder

SIZE = (320, 240)
PAUSE_SECONDS = 2.0  # between two late joiners


@dataclass(slots=True)
class Run:
    """The measurements of one run.

    moments  seconds of each track
    memory   of each process: resident megabytes, some fifty times
    work     of each process: seconds of processor time, when last seen
    joined   seconds until each late joiner had the last model
    frozen   seconds for which the frozen readers were that
    received    tracks that each other reader received
    """

    moments: list[float] = field(default_factory=list)
    memory: dict[str, list[float]] = field(default_factory=dict)
    work: dict[str, float] = field(default_factory=dict)
    joined: list[float] = field(default_factory=list)
    frozen: float = 0.0
    received: list[int] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Frames per second from the first track to the last."""
        return (len(self.moments) - 1) / (self.moments[-1] - self.moments[0])


def figures(options: argparse.Namespace) -> Iterator[Table]:
    frames, readers, frozen, runs = options.frames, options.readers, options.frozen, options.runs
    if options.quick:
        frames, readers, frozen, runs = 40, 2, 1, 1
    alone, beside = [], []
    for _ in range(runs):  # alternating, so that other load of the machine affects both alike
        alone.append(travel(frames, 0, 0))
        beside.append(travel(frames, readers, frozen))

    columns = ("subscribers", "frozen", "for s", "frames", "frames/s", "slowest run", "ratio")
    base, rows = median(run.rate for run in alone), []
    for all_runs, connected, stopped in ((alone, 0, 0), (beside, readers, frozen)):
        rate, seconds = median(run.rate for run in all_runs), median(run.frozen for run in all_runs)
        rows.append((connected, stopped, seconds, frames, rate, min(run.rate for run in all_runs), rate / base))
    yield Table("Frames a second", columns, rows, f"median of {runs} runs each, made in turn")

    columns = ("subscribers", "process", "MB at a quarter", "MB at the end", "most", "CPU ms a frame")
    rows = [
        (connected, name, seen[len(seen) // 4], seen[-1], max(seen), 1000 * run.work[name] / frames)
        for connected, run in ((0, alone[-1]), (readers, beside[-1]))
        for name, seen in run.memory.items()
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


def travel(frames: int, readers: int, frozen: int) -> Run:
    """Run a pipeline over the whole video, with subscribers that connect at its start."""
    sequence, run, ended = rendered(frames, SIZE), Run(), threading.Event()
    with private_folder() as folder, Subscribers(str(folder), readers, frozen=frozen) as group:
        late = threading.Thread(target=join, args=(str(folder), ended, run.joined))
        with Pipeline(video(sequence), sequence.boxes[0], Settings(run={"endpoint": str(folder)})) as pipeline:
            try:
                for track in pipeline:
                    run.moments.append(perf_counter())
                    if readers and track.model_version and late.ident is None:
                        late.start()
                    if track.frame % (frames // 50 + 1) == 0:
                        group.freeze()
                        for name, pid in pipeline.pids.items():
                            look(run, name, pid)
            finally:
                ended.set()
                if late.ident is not None:
                    late.join()
        group.wait()
        run.frozen, run.received = group.frozen_seconds, group.received()
    return run


def look(run: Run, name: str, pid: int) -> None:
    with suppress(psutil.NoSuchProcess):  # the process has just ended
        process = psutil.Process(pid)
        run.memory.setdefault(name, []).append(process.memory_info().rss / 1e6)
        run.work[name] = sum(process.cpu_times()[:2])


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
    parser = command(__doc__)
    parser.add_argument("--frames", type=int, default=4_000, help="frames of each run (default: %(default)s)")
    parser.add_argument("--readers", type=int, default=200, help="number of subscribers (default: %(default)s)")
    parser.add_argument("--frozen", type=int, default=20, help="number of those that are frozen (default: %(default)s)")
    parser.add_argument(
        "--runs", type=int, default=2, help="number of runs with and without subscribers (default: %(default)s)"
    )
    options = parser.parse_args()
    publish(figures(options), options)
