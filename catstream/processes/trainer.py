"""The process that trains models; always on the newest sample, as older ones are stale."""

from __future__ import annotations

from threading import Thread

from catstream.processes.process import MESSAGE_SECONDS, Process
from catstream.training import motion_em
from catstream.training.trainer import Trainer
from catstream.wire.channels import MODELS, SAMPLES
from catstream.wire.messages import End
from catstream.wire.newest import Publisher, Subscriber

_NONE = {"version": 0.0, "trained": 0.0}


def main(process: Process) -> None:
    """Train a model from each sample that arrives, until the stream ends; the objects take turns."""
    Thread(target=motion_em.prepare).start()  # the first models need no motion, and do not wait for it
    trainer = Trainer(process.settings)
    trained: dict[str, dict[str, float]] = {}
    with Subscriber(SAMPLES, process.endpoint) as samples, Publisher(MODELS, process.endpoint) as models:
        while not process.ending.reason:
            message = samples.receive(MESSAGE_SECONDS)  # of the object that has waited longest
            if isinstance(message, End):
                process.ending.receive(message)
            # An older version comes from a restarted compressor that lost the newer one; a detector may need its model.
            elif message is not None and message.version != trained.get(message.object, _NONE)["version"]:
                process.watchdog.allow()
                models.send(trainer.train(message))
                count = trained.pop(message.object, _NONE)["trained"] + 1
                trained[message.object] = {"version": float(message.version), "trained": count}
                if len(trained) > process.settings.run.max_objects:  # the longest ago: it was forgotten
                    del trained[next(iter(trained))]
            models.serve_late_joiners()
            process.beat(lambda: _totals(trained), lambda: trained, now=process.ending.ended)
        process.watchdog.allow()


def _totals(trained: dict[str, dict[str, float]]) -> dict[str, float]:
    """The counters of all objects together."""
    return {
        "version": max((counters["version"] for counters in trained.values()), default=0.0),
        "trained": sum(counters["trained"] for counters in trained.values()),
    }
