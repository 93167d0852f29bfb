"""The process that trains models; always on the newest sample, as older ones are stale."""

from __future__ import annotations

from dataclasses import replace
from threading import Timer

from catstream.processes.process import MESSAGE_SECONDS, Process
from catstream.training import motion_em
from catstream.training.trainer import Trainer
from catstream.wire.channels import MODELS, SAMPLES
from catstream.wire.messages import End
from catstream.wire.newest import Publisher, Subscriber

_IMPORT_SECONDS = 2.0  # after the first block of centres: earlier, the import takes the time of the first tracks
_NONE = {"version": 0.0, "trained": 0.0}


def main(process: Process) -> None:
    """Train a model from each sample that arrives, until the stream ends; the objects take turns."""
    trainer, run = Trainer(process.settings), process.settings.run
    preparation = Timer(_IMPORT_SECONDS, motion_em.prepare)
    trained: dict[str, dict[str, float]] = {}
    with Subscriber(SAMPLES, process.endpoint) as samples, Publisher(MODELS, process.endpoint) as models:
        while not process.ending.reason:
            message = samples.receive(MESSAGE_SECONDS)  # of the object that has waited longest
            if isinstance(message, End):
                process.ending.receive(message)
            # An older version comes from a restarted compressor that lost the newer one; a detector may need its model.
            elif message is not None and message.version != trained.get(message.object, _NONE)["version"]:
                process.watchdog.allow()
                if len(message.centres) and not run.lockstep and run.lag_frames:
                    if preparation.ident is None:
                        preparation.start()
                    if preparation.is_alive():  # train without motion: the detector does not wait for the import
                        message = replace(message, centres=message.centres[:0])
                models.send(trainer.train(message))
                count = trained.pop(message.object, _NONE)["trained"] + 1
                trained[message.object] = {"version": float(message.version), "trained": count}
                if len(trained) > process.settings.run.max_objects:  # the longest ago: it was forgotten
                    del trained[next(iter(trained))]
            models.serve_late_joiners()
            process.beat(lambda: _totals(trained), lambda: trained, now=process.ending.ended)
        process.watchdog.allow()
    preparation.cancel()


def _totals(trained: dict[str, dict[str, float]]) -> dict[str, float]:
    """The counters of all objects together."""
    return {
        "version": max((counters["version"] for counters in trained.values()), default=0.0),
        "trained": sum(counters["trained"] for counters in trained.values()),
    }
