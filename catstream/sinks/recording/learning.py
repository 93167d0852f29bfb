"""Train from a recording again, without the video: with the recorded settings, or with others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from catstream.compression.forest import Forest
from catstream.errors import RecordingError
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features, Model, ObjectFeatures
from catstream.messages.names import counted
from catstream.numerics.threads import one_thread
from catstream.run.learned import begun
from catstream.settings import Settings
from catstream.sinks.recording.file import Recording
from catstream.training.trainer import Trainer
from catstream.wire.codec import encode


@dataclass(slots=True)
class Prequential:
    """Prequential evaluation (test, then train): each model is tested on the rows of frames that it has not seen.

    The rows of a frame are scored by the newest model of an earlier frame; frames before the first model are skipped.

    frames     with rows of the object and of the background
    separated  how many of them have all rows of the object scored above all rows of the background
    """

    frames: int = 0
    separated: int = 0
    _errors: float = 0.0
    _weights: float = 0.0

    def add(self, model: Model | None, features: ObjectFeatures) -> None:
        """Test a model of an object on its rows of one frame."""
        training = features.training.get(APPEARANCE)
        if model is None or training is None:
            return
        scores = training.rows @ model.weights + np.float32(model.bias)
        self._errors += float(training.weights @ (scores - training.labels) ** 2)
        self._weights += float(training.weights.sum())
        objects, others = scores[training.labels == 1], scores[training.labels == 0]
        if len(objects) and len(others):
            self.frames += 1
            self.separated += bool(objects.min() > others.max())

    @property
    def error(self) -> float:
        """Weighted mean squared difference between score and label; NaN before the first test."""
        return self._errors / self._weights if self._weights else float("nan")

    @property
    def separated_share(self) -> float:
        """Share of separated frames; NaN if there is no frame."""
        return self.separated / self.frames if self.frames else float("nan")


@dataclass(slots=True)
class Retraining:
    """Result of training from a recording again.

    settings     used for compression and training
    models       how many were trained
    identical    how many of them equal the recorded model of the same version bit for bit
    seconds      of compression and training
    counters     of the compressor at the end
    levels       of the nodes of each object's own tree, oldest first, by the name of the object
    prequential  evaluation of the models
    """

    settings: Settings
    models: int = 0
    identical: int = 0
    seconds: float = 0.0
    counters: dict[str, float] = field(default_factory=dict)
    levels: dict[str, tuple[int, ...]] = field(default_factory=dict)
    prequential: Prequential = field(default_factory=Prequential)


def require_features(recording: Recording, *, incomplete: bool = False) -> None:
    """Raise RecordingError if the recording has no features, or, unless `incomplete`, if some are missing."""
    if not recording.counts[Features]:
        raise RecordingError(f"{recording.path} holds no features to learn from: {recording}")
    if (missing := recording.missing[Features]) and not incomplete:
        raise RecordingError(
            f"{recording.path} misses the features of {counted(missing, 'frame')}, so the models cannot be reproduced: "
            "record a whole run with `catstream track --record`, or train from the features that it has (--incomplete)"
        )


@one_thread()  # as in the processes: more threads add in another order, which changes the bits
def learn(
    recording: Recording,
    settings: Settings,
    *,
    incomplete: bool = False,
    keep: Callable[[Model], None] | None = None,
    step: Callable[[], None] | None = None,
) -> Retraining:
    """Feed the recorded features to a fresh forest, and each sample to a fresh trainer.

    A model depends on the settings and on the features up to its frame, not on the time of training. With the recorded
    settings each recorded model is therefore reproduced bit for bit under its version, whether or not the pipeline ran
    in lockstep. The trainer of a pipeline skips samples that are outdated when it becomes idle; here every sample is
    trained on, so there may be more models.

    Parameters
    ----------
    incomplete : train although features are missing; the models then differ
    keep : called with each model
    step : called after each frame

    Raises
    ------
    RecordingError
        As `require_features` does.
    """
    require_features(recording, incomplete=incomplete)
    recorded = {model.version: encode(model) for model in recording.models()}
    forest, trainer, result = Forest(settings), Trainer(settings), Retraining(settings)
    newest: dict[str, Model] = {}
    for features in _numbered(recording):
        for name, part in features.objects.items():
            result.prequential.add(newest.get(name), part)
        started = time.perf_counter()
        models = [trainer.train(sample) for sample in forest.take(features, begun(features, settings))]
        result.seconds += time.perf_counter() - started
        for model in models:
            newest[model.object] = model
            result.models += 1
            result.identical += encode(model) == recorded.get(model.version)
            if keep is not None:
                keep(model)
        if step is not None:
            step()
    result.counters = forest.counters()
    result.levels = {
        name: tuple(node.level for node in compressor.trees["object"].nodes)
        for name, compressor in forest.compressors.items()
    }
    return result


def prequential_of_recorded(recording: Recording) -> Prequential:
    """Evaluate the recorded models themselves."""
    models = {(model.object, model.frame): model for model in recording.models()}
    prequential, newest = Prequential(), dict[str, Model]()
    for features in recording.features():
        for name, part in features.objects.items():
            prequential.add(newest.get(name), part)
            if (model := models.get((name, features.frame))) is not None:
                newest[name] = model
    return prequential


def _numbered(recording: Recording) -> Iterator[Features]:
    """Yield the recorded features, numbered without gaps."""
    for seq, features in enumerate(recording.features(), start=1):
        yield features if features.seq == seq else replace(features, seq=seq)
