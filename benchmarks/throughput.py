"""End-to-end frames per second of the real pipeline, including decoding, and the time of each stage.

A file that is fast to decode and small (TLD_01_david, 320x240), and a rendered one of 640x480 pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from journey import travel
from sequences import named, rendered, video
from table import Table, benchmark, command

from catstream.applications.evaluation.datasets import Sequence
from catstream.applications.evaluation.scores import score
from catstream.box import Box
from catstream.compression.forest import Forest
from catstream.detection.objects import Detectors
from catstream.features.pyramid import Pyramid
from catstream.messages.names import UNNAMED
from catstream.settings import Settings
from catstream.training.trainer import Trainer

MODES = ("local", "full")


def figures(options: argparse.Namespace) -> Iterator[Table]:
    videos = [named(options, "TLD_01_david")] + ([] if options.quick else [rendered(600)])
    modes, runs = (MODES[-1:], 1) if options.quick else (MODES, options.runs)
    found = [(sequence, mode, *repeated(sequence, mode, runs)) for sequence in videos for mode in modes]
    columns = ("video", "detection", "frames", "frames/s", "slowest run", "success")
    rows = [(sequence.name, mode, len(sequence), *seen) for sequence, mode, *seen in found]
    note = "three processes, from the first track to the last; the paper: 3 frames/s, n <= 64"
    yield Table("End to end", columns, rows, note)
    yield steps(videos)


def repeated(sequence: Sequence, mode: str, runs: int) -> tuple[float, float, float]:
    """Return median and minimum frames per second of some runs, and the success of the last one."""
    rates = []
    for _ in range(runs):
        journey = travel(video(sequence), sequence.boxes[0], Settings(search={"mode": mode}))
        rates.append(journey.rate)
    return median(rates), min(rates), score(np.array(journey.boxes), sequence.boxes).success


def steps(videos: list[Sequence]) -> Table:
    """Return the milliseconds per frame of each of the three stages, run in one process."""
    columns = ("video", "detection", "decode", "detect", "compress", "train", "all")
    rows = []
    for sequence in videos:
        for mode in MODES:
            spent = np.array(costs(sequence, Settings(search={"mode": mode}))) / len(sequence)
            rows.append((sequence.name, mode, *spent.tolist(), float(spent.sum())))
    return Table("Milliseconds a frame, on one core", columns, rows, "in the pipeline the last three run side by side")


def costs(sequence: Sequence, settings: Settings) -> list[float]:
    """Total milliseconds of decoding, detection, compression and training."""
    detectors, forest, trainer = Detectors(settings), Forest(settings), Trainer(settings)
    spent = [0.0] * 4

    def timed(step: int, work: Callable[..., Any], *arguments: Any) -> Any:
        begin = perf_counter()
        answer = work(*arguments)
        spent[step] += (perf_counter() - begin) * 1000
        return answer

    frames = sequence.frames()
    for row in range(len(sequence)):
        image = timed(0, next, frames)
        frame = timed(1, Pyramid, image)
        given = {} if row else {UNNAMED: timed(1, detectors.begin, UNNAMED, frame, Box(*sequence.boxes[0]))}
        _, features = timed(1, detectors.step, frame, 0.0, given)
        for sample in timed(2, forest.take, features):
            detectors.adopt(timed(3, trainer.train, sample))
    return spent


if __name__ == "__main__":
    benchmark(figures, command(__doc__), runs=(3, "number of runs of each video"))
