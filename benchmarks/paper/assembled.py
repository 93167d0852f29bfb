"""Trackers assembled from the stages of the library by several recipes, on the same sequences."""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from time import perf_counter
from unittest.mock import patch

import numpy as np
from accuracy import TrackerRun, starts_of
from starts import Start

from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.base.workers import SPAWN
from catstream.coreset.compressor import Compressor
from catstream.coreset.tree import CoresetTree
from catstream.detection.objects import Detectors
from catstream.detection.scm import SparseCollaborativeModel
from catstream.features.pyramid import Pyramid
from catstream.measure.datasets import Sequence
from catstream.training.trainer import Trainer


@dataclass(frozen=True, slots=True)
class Recipe:
    """The parts of a tracker.

    settings  of the stages
    tree      class of the compressor's trees: its `sample` is the training set
    learned   share of the frames that it learns from, the first ones; the rest it only follows
    """

    settings: Settings
    tree: type[CoresetTree] = CoresetTree
    learned: float = 1.0


def follow_all(
    options: argparse.Namespace, sequences: list[Sequence], recipes: dict[str, Recipe]
) -> dict[str, list[TrackerRun]]:
    """Run each recipe over all sequences and starts; return the runs in the same order for each."""
    starts, jobs = starts_of(options), 1 if options.quick else options.jobs
    tasks = [(recipes, sequence, start) for sequence in sequences for start in starts(sequence)]
    runs: dict[str, list[TrackerRun]] = {name: [] for name in recipes}
    with ProcessPoolExecutor(jobs, mp_context=SPAWN) as pool:
        for found in (map if jobs == 1 else pool.map)(follow_each, *zip(*tasks, strict=True)):
            for run in found:
                runs[run.tracker].append(run)
    return runs


def follow_each(recipes: dict[str, Recipe], sequence: Sequence, start: Start) -> list[TrackerRun]:
    """Run each recipe on one sequence, from the same start."""
    runs = []
    # SCM is slow and does not depend on the recipe, so each frame is computed once for all recipes.
    with patch("catstream.detection.scm.SparseCollaborativeModel", Shared()):
        for name, recipe in recipes.items():
            runs.append(follow(name, recipe, sequence, start))
            print(f"{name}: {sequence.name}", file=sys.stderr)
    return runs


class Shared:
    """Replaces the class SCM for one sequence: caches the result of each frame for all recipes."""

    model: SparseCollaborativeModel

    def __init__(self) -> None:
        self.found: list[tuple[float, Box]] = []

    def __call__(self, image: np.ndarray, box: Box, rng: np.random.Generator) -> Shared:
        if not self.found:
            self.model = SparseCollaborativeModel(image, box, rng)
        self.told = 0
        return self

    def track(self, image: np.ndarray) -> tuple[float, Box]:
        """Return the cached result of SCM for a frame."""
        if self.told == len(self.found):
            self.found.append(self.model.track(image))
        self.told += 1
        return self.found[self.told - 1]


def follow(name: str, recipe: Recipe, sequence: Sequence, start: Start) -> TrackerRun:
    """Run the loop of `catstream.tracker.Tracker` with other trees, and stop learning after a share of the frames."""
    rest, first = sequence.since(start.frame), start.box(sequence)
    frames = len(rest)
    settings = recipe.settings.for_length(frames)
    detectors, compressor, trainer = Detectors(settings), Compressor(settings), Trainer(settings)
    compressor.trees = {name: recipe.tree(settings.coreset.size) for name in compressor.trees}
    boxes, moments = [], [perf_counter()]
    with one_thread(opencv=True):
        for row, image in enumerate(rest.frames()):
            frame = Pyramid(image)
            given = {}
            if row == 0:
                given[UNNAMED] = detectors.begin(UNNAMED, frame, first)
            tracks, features = detectors.step(frame, results=given)
            track = tracks.tracks[UNNAMED]
            part, version = features.objects[UNNAMED], compressor.version + 1
            sample = compressor.take(row, part, version) if row < recipe.learned * frames else None
            if sample is not None:
                detectors.adopt(trainer.train(sample))
            boxes.append(track.box or (np.nan,) * 4)
            moments.append(perf_counter())
    return TrackerRun(rest, np.array(boxes), np.diff(moments), name, start)
