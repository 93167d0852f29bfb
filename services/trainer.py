"""The process that trains models; always on the newest sample, as older ones are stale."""

from __future__ import annotations

from catstream.messages.kinds import End
from catstream.services.loop import Process
from catstream.services.timing import CLOSE_SECONDS, MESSAGE_SECONDS, TRAIN_SECONDS
from catstream.training.trainer import Trainer
from catstream.wire.channels import MODELS, SAMPLES
from catstream.wire.newest import Publisher, Subscriber

_NONE = {"version": 0.0, "trained": 0.0}


def prepare() -> None:
    """Everything that training needs is imported already."""


def main(process: Process) -> None:
    """Train a model from each sample that arrives, until the stream ends; the objects take turns."""
    trainer = Trainer(process.settings)
    trained: dict[str, dict[str, float]] = {}
    with Subscriber(SAMPLES, process.endpoint) as samples, Publisher(MODELS, process.endpoint) as models:
        while not process.stop_requested:
            message = samples.receive(MESSAGE_SECONDS)  # of the object that has waited longest
            if isinstance(message, End):
                process.source_failed = message.failed
                process.beat(lambda: _totals(trained), lambda: trained, now=True)
                break
            # An older version comes from a restarted compressor that lost the newer one; a detector may need its model.
            if message is not None and message.version != trained.get(message.object, _NONE)["version"]:
                process.watchdog.allow(TRAIN_SECONDS)
                models.send(trainer.train(message))
                count = trained.pop(message.object, _NONE)["trained"] + 1
                trained[message.object] = {"version": float(message.version), "trained": count}
                if len(trained) > process.settings.run.objects_most:  # the longest ago: it was forgotten
                    del trained[next(iter(trained))]
            models.serve_late_joiners()
            process.beat(lambda: _totals(trained), lambda: trained)
        process.watchdog.allow(CLOSE_SECONDS)


def _totals(trained: dict[str, dict[str, float]]) -> dict[str, float]:
    """The counters of all objects together."""
    return {
        "version": max((each["version"] for each in trained.values()), default=0.0),
        "trained": sum(each["trained"] for each in trained.values()),
    }
