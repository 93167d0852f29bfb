"""Frequent directions in place of the coreset tree: accuracy, time and memory.

Accuracy is measured on the sequences on which the defaults were chosen, from several start frames of each. For time and
memory, one sequence is tracked with the default, and the features of each frame are given to a compressor of each kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from statistics import fmean
from time import perf_counter

import numpy as np
from accuracy import MEANS, accuracy_command, compared, described, difference, means, videos
from sequences import TUNED, named
from table import Cell, Table, benchmark

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.compression.forest import Forest
from catstream.compression.tree import REDUCTIONS
from catstream.detection.objects import Detectors
from catstream.evaluation.datasets import Sequence
from catstream.evaluation.runs import EvaluationRun
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import Features, Model
from catstream.training.trainer import Trainer

COLUMNS = ("coreset.reduction", *MEANS, "AUC above svd", "± standard error", "frames/s")
COSTS = ("coreset.reduction", "frames", "rows", "MB", "most MB", "energy kept", "ms a frame", "p99 ms", "training ms")


def figures(options: argparse.Namespace) -> Iterator[Table]:
    variants = {name: Settings(coreset={"reduction": name}) for name in REDUCTIONS}
    yield costs(named(options, options.sequence), variants)
    found = [video for video in videos(options) if options.quick or video.name in TUNED]
    runs = compared(options, found, variants)
    rows = [
        (name, *means(found), *difference(found, runs["svd"]), frames_per_second(found)) for name, found in runs.items()
    ]
    yield Table("Accuracy", COLUMNS, rows, f"{len(found)} sequences, {described(options)} of each")


class Stages:
    """A forest and a trainer with their times in seconds, and the most bytes of the trees."""

    def __init__(self, settings: Settings) -> None:
        self.forest, self.trainer = Forest(settings), Trainer(settings)
        self.compression: list[float] = []
        self.training: list[float] = []
        self.most_bytes = 0.0

    def take(self, features: Features) -> Model | None:
        began = perf_counter()
        samples = self.forest.take(features)
        self.compression.append(perf_counter() - began)
        self.most_bytes = max(self.most_bytes, self.forest.counters()["bytes"])
        if not samples:
            return None
        began = perf_counter()
        model = self.trainer.train(samples[0])
        self.training.append(perf_counter() - began)
        return model

    def row(self, name: str) -> tuple[Cell, ...]:
        trees, counters = self.forest.compressors[""].trees.values(), self.forest.counters()
        dropped = sum(tree.dropped_energy for tree in trees) / sum(node.energy for tree in trees for node in tree.nodes)
        frames, rows, size = len(self.compression), int(counters["rows"]), counters["bytes"] / 1e6
        mean, slow = 1000 * fmean(self.compression), 1000 * float(np.quantile(self.compression, 0.99))
        return name, frames, rows, size, self.most_bytes / 1e6, 1 - dropped, mean, slow, 1000 * fmean(self.training)


def costs(sequence: Sequence, variants: dict[str, Settings]) -> Table:
    """Track a sequence with the default, and give the features of each frame to all variants."""
    detectors = Detectors(variants["svd"])
    stages = {name: Stages(settings) for name, settings in variants.items()}
    for number, image in enumerate(sequence.frames()):
        pyramid = Pyramid(image)
        given = {} if number else {"": detectors.begin("", pyramid, Box(*sequence.boxes[0]))}
        _, features = detectors.step(pyramid, 0.0, given)
        models = {name: each.take(features) for name, each in stages.items()}
        if (model := models["svd"]) is not None:
            detectors.adopt(model)
    rows = [each.row(name) for name, each in stages.items()]
    return Table(f"Costs on {sequence.name}", COSTS, rows, "MB of all trees; ms a frame of the compressor")


def frames_per_second(runs: list[EvaluationRun]) -> float:
    return sum(len(run.seconds) for run in runs) / sum(float(np.sum(run.seconds)) for run in runs)


if __name__ == "__main__":
    benchmark(figures, accuracy_command(__doc__, starts=3), sequence=("TLD_10_panda", "sequence of the costs"))
