"""Learns a saved model from a part of a sequence, and tracks with it in another part or another sequence."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from typing import TypeVar

import numpy as np
from sequences import CHECK, sequences
from table import command

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.base.workers import SPAWN
from catstream.compression.compressor import Compressor
from catstream.detection.detector import Detector
from catstream.evaluation.datasets import Sequence
from catstream.features.pyramid import Pyramid
from catstream.jobs.saved_model import SavedModel
from catstream.messages.kinds import ObjectFeatures, Track
from catstream.training.trainer import Trainer

_LEAST, _MOST = 20, 250  # frames that a model is learned from
Task, Result = TypeVar("Task"), TypeVar("Result")


def learning_command(about: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of a benchmark of saved models."""
    parser = command(about)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of processes (default: %(default)s)")
    parser.add_argument("--check", action="store_true", help="the sequences of the check list, not the others")
    parser.add_argument("--frames", type=int, default=100, help="frames to track in (default: %(default)s)")
    return parser


def chosen(options: argparse.Namespace) -> list[Sequence]:
    """Return the sequences of the check list, or all others."""
    return [found for found in sequences(options) if options.quick or (found.name in CHECK) == options.check]


def each(options: argparse.Namespace, work: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
    """Do the work for each task in several processes; yield the results in the order of the tasks."""
    if options.quick or options.jobs == 1:
        yield from map(work, tasks)
        return
    with ProcessPoolExecutor(options.jobs, mp_context=SPAWN) as pool:
        yield from pool.map(work, tasks)


def training_frames(sequence: Sequence) -> int:
    """Return the number of frames in the first third of a sequence, which its model is learned from."""
    return min(max(len(sequence) // 3, _LEAST), _MOST, max(len(sequence) - 2, 1))


def features(sequence: Sequence, start: int, count: int, settings: Settings) -> list[ObjectFeatures]:
    """Return the features of frames that a tracker learned from, which started at the true box."""
    detector, compressor, trainer = Detector(settings), Compressor(settings), Trainer(settings)
    found = []
    with one_thread(opencv=True):
        for seq, image in enumerate(islice(sequence.frames(start), count), start=1):
            frame = Pyramid(image)
            if seq == 1:
                _, part = detector.init(frame, seq, 0.0, Box(*map(float, sequence.boxes[start])))
            else:
                _, part = detector.update(detector.search(frame, seq), frame, seq, 0.0)
            learn(detector, compressor, trainer, seq, part)
            found.append(part)
    return found


def learn(detector: Detector, compressor: Compressor, trainer: Trainer, seq: int, part: ObjectFeatures) -> None:
    """Compress the features of a frame; the detector adopts the model if there is a new one."""
    sample = compressor.take(seq - 1, part, compressor.version + 1)
    if sample is not None:
        detector.adopt(trainer.train(sample))


def model_of(found: Iterable[ObjectFeatures], settings: Settings) -> SavedModel:
    """Return the saved model of one tree that has seen all features, in the given order."""
    compressor = Compressor(settings)
    for frame, part in enumerate(found):
        compressor.take(frame, part, compressor.version + 1)
    return SavedModel.of(compressor, settings)


def tracked(learned: SavedModel, sequence: Sequence, start: int, count: int) -> list[Track]:
    """Return the tracks of a run that starts with a saved model and learns on."""
    settings = learned.settings
    detector, compressor, trainer = Detector(settings), learned.compressor(settings), Trainer(settings)
    detector.seek(learned.model, learned.box, learned.similarity())
    tracks = []
    with one_thread(opencv=True):
        for seq, image in enumerate(islice(sequence.frames(start), count), start=1):
            frame = Pyramid(image)
            track, part = detector.update(detector.search(frame, seq), frame, seq, 0.0)
            learn(detector, compressor, trainer, seq, part)
            tracks.append(track)
    return tracks


def hits(tracks: Iterable[Track], sequence: Sequence, start: int) -> list[bool]:
    """Return for each track whether its box overlaps the true one by half; frames without a true box are left out."""
    boxes = sequence.boxes[start:]
    return [
        track.box is not None and track.box.overlap(Box(*map(float, truth))) > 0.5
        for track, truth in zip(tracks, boxes, strict=False)
        if np.isfinite(truth).all()
    ]
