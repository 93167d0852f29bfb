"""The process that trains models; always on the newest sample, as older ones are stale."""

from __future__ import annotations

from catstream import kalman
from catstream.messages import End
from catstream.services.loop import Process
from catstream.training.trainer import Trainer
from catstream.wire.channels import MODELS, SAMPLES
from catstream.wire.newest import Publisher, Subscriber

__all__ = ["main"]

_TRAIN_SECONDS = 60.0  # limit for training a model, and for the imports of the first one


def main(process: Process) -> None:
    """Train a model from each sample that arrives, until the stream ends."""
    trainer = Trainer(process.settings)
    counters = {"version": 0.0, "trained": 0.0}
    with Subscriber(SAMPLES, process.endpoint) as samples, Publisher(MODELS, process.endpoint) as models:
        while not process.stop_requested:
            message = samples.receive(0.1)
            if isinstance(message, End):
                process.source_failed = message.failed
                process.beat(counters.copy, now=True)
                return
            # An older version comes from a restarted compressor that lost the newer one; a detector may need its model.
            if message is not None and message.version != counters["version"]:
                process.allow(_TRAIN_SECONDS)
                models.send(trainer.train(message))
                if message.frame >= process.settings.search.motion_frames // 2:
                    kalman.prepare()  # a sample contains the centres after twice as many frames
                counters = {"version": float(message.version), "trained": counters["trained"] + 1}
            models.serve_late_joiners()
            process.beat(counters.copy)
