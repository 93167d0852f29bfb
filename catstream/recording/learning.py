"""Learn from a recording once more, without the video: with the settings of then, or with others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from catstream.compression.compressor import Compressor
from catstream.errors import RecordingError
from catstream.heads import APPEARANCE
from catstream.messages import Features, Model
from catstream.recording.file import Recording
from catstream.settings import Settings
from catstream.threads import one_thread
from catstream.training.trainer import Trainer
from catstream.wire.codec import encode

__all__ = ["Lesson", "Marks", "check", "learn", "marks_of"]


@dataclass(slots=True)
class Marks:
    """How well models tell the rows of the frames after them: each is marked on what it has not seen yet.

    A frame is scored by the newest model of a frame before it, and not before the first.
    """

    frames: int = 0
    won: int = 0
    _errors: float = 0.0
    _weights: float = 0.0

    def add(self, model: Model | None, features: Features) -> None:
        """Mark a model on the rows of one frame."""
        training = features.training.get(APPEARANCE)
        if model is None or training is None:
            return
        scores = training.rows @ model.weights + np.float32(model.bias)
        self._errors += float(training.weights @ (scores - training.labels) ** 2)
        self._weights += float(training.weights.sum())
        objects, others = scores[training.labels == 1], scores[training.labels == 0]
        if len(objects) and len(others):
            self.frames += 1
            self.won += bool(objects.min() > others.max())

    @property
    def error(self) -> float:
        """Mean squared difference of score and label, rows weighted; NaN where nothing was marked."""
        return self._errors / self._weights if self._weights else float("nan")

    @property
    def apart(self) -> float:
        """Share of the frames in which each row of the object scores above all of the background; NaN where none."""
        return self.won / self.frames if self.frames else float("nan")


@dataclass(slots=True)
class Lesson:
    """What came of learning from a recording.

    settings   it was learned with
    models     how many were made
    identical  how many of them are the recorded ones of the same version, bit for bit
    seconds    of compression and training
    counters   of the compressor, at the end
    levels     of the nodes of the object's tree, oldest first
    marks      of the models
    """

    settings: Settings
    models: int = 0
    identical: int = 0
    seconds: float = 0.0
    counters: dict[str, float] = field(default_factory=dict)
    levels: tuple[int, ...] = ()
    marks: Marks = field(default_factory=Marks)


def check(recording: Recording, *, incomplete: bool = False) -> None:
    """Raise RecordingError where features are missing that are needed to learn from it, or there are none."""
    if not recording.counts[Features]:
        raise RecordingError(f"{recording.path} holds no features to learn from: {recording}")
    if (missing := recording.missing[Features]) and not incomplete:
        raise RecordingError(
            f"{recording.path} misses the features of {missing} frames, so no model can come out as it was: record a "
            "whole run with `catstream track --record`, or learn from what is there (--incomplete)"
        )


@one_thread()  # as the processes have: more threads add in another order
def learn(
    recording: Recording,
    settings: Settings,
    *,
    incomplete: bool = False,
    keep: Callable[[Model], None] | None = None,
    step: Callable[[], None] | None = None,
) -> Lesson:
    """Feed the recorded features to a fresh compressor, and each sample to a fresh trainer.

    A model depends on the settings and on the features up to its frame, not on when it was learned. So
    each recorded model comes out again, bit for bit, under its version, where the settings are the same: from
    a pipeline in lockstep and any other. The trainer of a pipeline skips samples that are stale by the time
    it is free, and misses these versions; here all are made.

    Parameters
    ----------
    incomplete : learn though features are missing; the models are others then
    keep : called with each model
    step : called after each frame

    Raises
    ------
    RecordingError
        As `check` does.
    """
    check(recording, incomplete=incomplete)
    recorded = {model.version: encode(model) for model in recording.models()}
    compressor, trainer, lesson = Compressor(settings), Trainer(settings), Lesson(settings)
    newest: Model | None = None
    for features in _numbered(recording):
        lesson.marks.add(newest, features)
        started = time.perf_counter()
        sample = compressor.take(features)
        model = trainer.train(sample) if sample is not None else None
        lesson.seconds += time.perf_counter() - started
        if model is not None:
            newest = model
            lesson.models += 1
            lesson.identical += encode(model) == recorded.get(model.version)
            if keep is not None:
                keep(model)
        if step is not None:
            step()
    lesson.counters = compressor.counters()
    lesson.levels = tuple(node.level for node in compressor.trees["object"].nodes)
    return lesson


def marks_of(recording: Recording) -> Marks:
    """Those of the recorded models themselves."""
    models = {model.frame: model for model in recording.models()}
    marks, newest = Marks(), None
    for features in recording.features():
        marks.add(newest, features)
        newest = models.get(features.frame, newest)
    return marks


def _numbered(recording: Recording) -> Iterator[Features]:
    """The features that are there, numbered without a gap."""
    for seq, features in enumerate(recording.features(), start=1):
        yield features if features.seq == seq else replace(features, seq=seq)
