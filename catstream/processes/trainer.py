"""The process that trains a model on the newest sample of each object; older samples are skipped."""

from __future__ import annotations

from dataclasses import replace
from threading import Timer

from catstream.processes.process import MESSAGE_SECONDS, Process
from catstream.training import motion_em
from catstream.training.trainer import Trainer
from catstream.wire.channels import MODELS, SAMPLES
from catstream.wire.messages import End
from catstream.wire.newest import Publisher, Subscriber

_IMPORT_SECONDS = 2.0  # delay after the first block of centres: an earlier import would delay the first tracks
_NONE = {"version": 0.0, "trained": 0.0}


def main(process: Process) -> None:
    """Train models until the stream ends; the object that has waited longest is next."""
    trainer, run = Trainer(process.settings), process.settings.run
    preparation = Timer(_IMPORT_SECONDS, motion_em.prepare)
    trained: dict[str, dict[str, float]] = {}
    with Subscriber(SAMPLES, process.endpoint) as samples, Publisher(MODELS, process.endpoint) as models:
        while not process.ending.reason:
            message = samples.receive(MESSAGE_SECONDS)
            if isinstance(message, End):
                process.ending.receive(message)
            # A restarted compressor may send an older version, whose model a detector may need.
            elif message is not None and message.version != trained.get(message.object, _NONE)["version"]:
                process.watchdog.allow()
                if len(message.centres) and not run.lockstep and run.lag_frames:
                    if preparation.ident is None:
                        preparation.start()
                    if preparation.is_alive():  # train without motion, so the detector does not wait for the import
                        message = replace(message, centres=message.centres[:0])
                models.send(trainer.train(message))
                count = trained.pop(message.object, _NONE)["trained"] + 1
                trained[message.object] = {"version": float(message.version), "trained": count}
                if len(trained) > process.settings.run.max_objects:
                    del trained[next(iter(trained))]  # trained the longest ago: it is no longer tracked
            models.serve_late_joiners()
            process.beat(lambda: _totals(trained), lambda: trained, now=process.ending.ended)
        process.watchdog.allow()
    preparation.cancel()


def _totals(trained: dict[str, dict[str, float]]) -> dict[str, float]:
    """The counters over all objects."""
    return {
        "version": max((counters["version"] for counters in trained.values()), default=0.0),
        "trained": sum(counters["trained"] for counters in trained.values()),
    }
