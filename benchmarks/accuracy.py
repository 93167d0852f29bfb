"""Compares the accuracy of several settings or trackers over the same sequences and starts."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, pstdev
from typing import Any

import numpy as np
from opencv_trackers import PEERS, Peer
from sequences import CHECK, sequences
from starts import FIRST, Start, Starts, jittered, one_pass, temporal
from table import command

from catstream.base.arrays import Float64
from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.base.workers import run_tasks
from catstream.errors import SettingsError
from catstream.measure.datasets import Sequence
from catstream.measure.onepass import Run, follow
from catstream.measure.scores import overlaps
from catstream.tracker import Tracker

#: Headings for the values of `means`.
MEANS = ("AUC", "success", "precision")

#: Difference of the smallest and the largest success over several initial boxes, above which a sequence flips.
FLIP = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class TrackerRun(Run):
    """A run of a tracker, by its name, from a start."""

    tracker: str = "catstream"
    start: Start = FIRST

    @property
    def name(self) -> str:
        return self.sequence.name + self.start.suffix


@dataclass(frozen=True, slots=True)
class Row:
    """The measures of one tracker on one sequence: means over its runs.

    The measures are those of `scores.Score`; `lost` is the share of the runs that have lost the object in the end, see
    `is_lost`. The numbers of frames, from `absent` on, are sums over the runs; the spreads are standard deviations over
    the runs. `flips` is None unless the runs have different initial boxes; it is true if their smallest and largest
    success differ by more than 0.25: then chance decides.
    """

    name: str
    tracker: str
    frames: int
    runs: int
    auc: float
    auc_spread: float
    success: float
    success_spread: float
    precision: float
    normalised_precision: float
    lost: float
    flips: bool | None
    fps: float
    absent: int
    noticed: int
    present: int
    false: int

    @classmethod
    def of(cls, runs: list[TrackerRun]) -> Row:
        scores = [run.score() for run in runs]
        auc, success = [score.auc for score in scores], [score.success for score in scores]
        return cls(
            name=runs[0].sequence.name,
            tracker=runs[0].tracker,
            frames=max(len(run.sequence) for run in runs),
            runs=len(runs),
            auc=fmean(auc),
            auc_spread=pstdev(auc),
            success=fmean(success),
            success_spread=pstdev(success),
            precision=fmean(score.precision for score in scores),
            normalised_precision=fmean(score.normalised_precision for score in scores),
            lost=fmean(is_lost(run.boxes, run.sequence.boxes) for run in runs),
            flips=max(success) - min(success) > FLIP if any(run.start.variation.name for run in runs) else None,
            fps=fmean(run.fps for run in runs),
            absent=sum(score.absent for score in scores),
            noticed=sum(score.noticed for score in scores),
            present=sum(score.present for score in scores),
            false=sum(score.false for score in scores),
        )


def is_lost(boxes: Float64, truth: Float64) -> bool:
    """Return whether fewer than half of the frames with the object in the last quarter have an overlap above 0.5."""
    last = slice(-math.ceil(len(truth) / 4), None)
    present = np.isfinite(truth[last]).all(axis=1)
    followed = overlaps(boxes[last], truth[last])[present] > 0.5
    return bool(len(followed)) and bool(followed.mean() < 0.5)


def rows_of(runs: Iterable[TrackerRun]) -> list[Row]:
    """Return a row for each sequence and tracker, in order of first occurrence."""
    groups: dict[tuple[str, str], list[TrackerRun]] = {}
    for run in runs:
        groups.setdefault((run.sequence.name, run.tracker), []).append(run)
    return [Row.of(group) for group in groups.values()]


def follow_from(tracker: str, settings: Settings, sequence: Sequence, start: Start, models: Path | None) -> TrackerRun:
    """Run one tracker, `catstream` or one of `PEERS`, from one start to the end of a sequence, in one thread."""
    part = sequence.since(start.frame)
    with one_thread(opencv=True):
        of_name = Tracker(settings.for_length(len(part))) if tracker == "catstream" else Peer(tracker, models)
        run = follow(part, of_name, start.box(sequence))
    return TrackerRun(run.sequence, run.boxes, run.seconds, tracker, start)


def run_all(
    found: list[Sequence],
    trackers: Iterable[str],
    settings: Settings,
    starts: Starts = one_pass,
    models: Path | None = None,
    jobs: int = 1,
) -> list[TrackerRun]:
    """Run trackers from all starts of all sequences, in so many processes, and print each run that has ended."""
    tasks = [
        (tracker, settings, sequence, start, models)
        for sequence in found
        for tracker in trackers
        for start in starts(sequence)
    ]
    runs = {}
    for run in in_processes(follow_from, tasks, jobs):
        print(f"{run.tracker}: {run.name}", file=sys.stderr)
        runs[run.tracker, run.name] = run
    return [runs[tracker, sequence.name + start.suffix] for tracker, _, sequence, start, _ in tasks]


def in_processes(work: Callable[..., Any], tasks: list[tuple[Any, ...]], jobs: int) -> Iterator[Any]:
    """Yield the result of `work` for each task, in order of completion; an error or Ctrl-C ends the processes."""
    if jobs == 1:
        yield from (work(*task) for task in tasks)
        return
    with closing(run_tasks(work, tasks, jobs)) as results:
        yield from results


def accuracy_command(about: str | None, starts: int = 1) -> argparse.ArgumentParser:
    """Return a parser with the options of a benchmark over many sequences and starts."""
    parser = command(about)
    parser.add_argument("--group", choices=("all", "tuning", "check"), default="all", help="only these sequences")
    parser.add_argument("--frames", type=int, help="number of frames of each sequence (default: all)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of processes (default: %(default)s)")
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument(
        "--starts", type=int, default=starts, help="number of start frames of each sequence (default: %(default)s)"
    )
    chosen.add_argument("--jitter", type=int, metavar="K", help="K first boxes within 2 %% instead")
    return parser


def videos(options: argparse.Namespace, prefix: str = "") -> list[Sequence]:
    """Return the sequences of `--group` whose names begin with `prefix`, cut to the first `--frames`."""
    found = shortened(options, prefix)
    if options.quick or options.group == "all":
        return found
    return [one for one in found if (one.name in CHECK) == (options.group == "check")]


def shortened(options: argparse.Namespace, prefix: str = "") -> list[Sequence]:
    """Return the sequences whose names begin with `prefix`, cut to the first `--frames`."""
    return [replace(found, boxes=found.boxes[: options.frames]) for found in sequences(options, prefix)]


def available(names: Iterable[str], models: Path | None = None) -> tuple[list[str], str]:
    """Return the trackers that this OpenCV has, and a line for each one that is missing."""
    trackers, missing = [], ""
    for name in names:
        try:
            if name in PEERS:
                Peer(name, models)
            trackers.append(name)
        except SettingsError as error:  # the message has the install command, or the names of the model files
            missing += f"\n{error}"
    return trackers, missing


def starts_of(options: argparse.Namespace) -> Starts:
    """Return the starts of each sequence that the options choose; with --quick, the first frame."""
    if options.quick:
        return one_pass
    return jittered(options.jitter) if options.jitter else temporal(options.starts)


def described(options: argparse.Namespace) -> str:
    """Return the starts of each sequence in words."""
    return f"{options.jitter} first boxes" if options.jitter else f"{options.starts} starts"


def compared(
    options: argparse.Namespace, sequences: list[Sequence], variants: dict[str, Settings]
) -> dict[str, list[TrackerRun]]:
    """Run catstream with each of several settings; return the runs by name, in the same order for each."""
    jobs = 1 if options.quick else options.jobs
    return {
        name: run_all(sequences, ["catstream"], settings, starts_of(options), jobs=jobs)
        for name, settings in variants.items()
    }


def means(runs: Iterable[TrackerRun]) -> tuple[float, float, float]:
    """Return the means of AUC, success and precision over the runs of each sequence, then over the sequences."""
    rows = rows_of(runs)
    return tuple(fmean(getattr(row, measure.lower()) for row in rows) for measure in MEANS)


def spread(runs: Iterable[TrackerRun]) -> float:
    """Return the standard deviation of the AUC over the runs of a sequence, averaged over the sequences."""
    return fmean(row.auc_spread for row in rows_of(runs))
