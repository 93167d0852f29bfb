"""Times of the parts of the algorithm in milliseconds, on one core."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from statistics import median
from time import perf_counter

import numpy as np
from sequences import rendered
from table import Table, benchmark, command

from catstream.applications.evaluation.datasets import Sequence
from catstream.compression.reduce import reduce
from catstream.features.cells import Cells
from catstream.features.colours import shades
from catstream.features.hog import grid
from catstream.features.pyramid import planes_of
from catstream.messages.kinds import Sample
from catstream.messages.names import UNNAMED
from catstream.multi import MultiTracker
from catstream.settings import Settings
from catstream.training.motion_em import learn_motion
from catstream.training.trainer import Trainer

SIZES = (64, 256)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    sequence = rendered(8 if options.quick else 600)
    work = list(detection(sequence)) + list(learning(sequence, SIZES[:1] if options.quick else SIZES)) + list(motion())
    runs = 1 if options.quick else options.runs
    rows = [(name, milliseconds(call, runs)) for name, call in work]
    yield Table("Kernels", ("step", "ms"), rows, f"median of {runs} after one to warm up")


def milliseconds(call: Callable[[], object], runs: int) -> float:
    """Return the median time of a call, after one warm-up call."""
    call()
    times = []
    for _ in range(runs):
        begin = perf_counter()
        call()
        times.append((perf_counter() - begin) * 1000)
    return median(times)


def detection(sequence: Sequence) -> Iterator[tuple[str, Callable[[], object]]]:
    """Time the detection in one image of 640x480 pixels."""
    image = next(sequence.frames())
    cells, planes = Cells.of(image), planes_of(image)
    weights = cells.row(0, 0)
    yield "HOG and colour, 640x480", lambda: grid(planes)
    yield "shades of its colours", lambda: shades(planes)
    windows = (cells.shape[0] - 7) * (cells.shape[1] - 7)
    yield f"score all {windows} windows of it", lambda: cells.respond(weights, 0.0)


def learning(sequence: Sequence, sizes: Iterable[int]) -> Iterator[tuple[str, Callable[[], object]]]:
    """Time the training on the coreset of a whole video, for each coreset size."""
    for n in sizes:
        sample = sample_of(sequence, n)
        rows = np.vstack([sample.trees["object"].rows, sample.trees["background"].rows])[: 2 * n]
        yield f"reduce {len(rows)} rows to n = {n}", lambda rows=rows, n=n: reduce(rows, n)
        for classifier in ("joint", "least-squares", "one-class"):
            trainer = Trainer(Settings(coreset={"size": n}, teaching={"classifier": classifier}))
            yield f"train, {classifier}, n = {n}", lambda trainer=trainer, sample=sample: trainer.train(sample)


def sample_of(sequence: Sequence, n: int) -> Sample:
    """Return the sample of the trees after tracking the whole sequence."""
    tracker = MultiTracker(Settings(coreset={"size": n}))
    for row, image in enumerate(sequence.frames()):
        if row == 0:
            tracker.init(image, {UNNAMED: sequence.boxes[0]})
        else:
            tracker.update(image)
    return tracker.forest.last_samples[0]  # the first frame teaches a leaf of each tree


def motion() -> Iterator[tuple[str, Callable[[], object]]]:
    """Time the motion model on a random walk."""
    for m in (64, 500):
        centres = np.random.default_rng(0).normal(size=(m, 2)).cumsum(axis=0) + 200
        yield f"EM of the Kalman filter, {m} centres", lambda centres=centres: learn_motion(centres)


if __name__ == "__main__":
    benchmark(figures, command(__doc__), runs=(21, "number of runs of each step"))
