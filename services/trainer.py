"""Samples in, models out: always from the newest, older ones are stale."""

from __future__ import annotations

from catstream import kalman
from catstream.messages import End, Sample
from catstream.services.loop import Process
from catstream.training.trainer import Trainer
from catstream.wire.channels import MODELS, SAMPLES
from catstream.wire.newest import Publisher, Subscriber

__all__ = ["main"]

_TRAIN_SECONDS = 60.0  # that learning a model may take, and the first one its imports


def main(process: Process) -> None:
    """Learn a model from each sample that comes, until the stream ends."""
    trainer = Trainer(process.settings)
    version = trained = 0
    with Subscriber(SAMPLES, process.endpoint) as samples, Publisher(MODELS, process.endpoint) as models:

        def counters() -> dict[str, float]:
            return {"version": version, "trained": trained}

        while not process.ended:
            message = samples.receive(0.1)
            # An older one comes from a compressor that lost the newer: it is made again, and a detector may need this.
            if isinstance(message, Sample) and message.version != version:
                process.allow(_TRAIN_SECONDS)
                models.send(trainer.train(message))
                if message.frame >= process.settings.search.motion_frames // 2:
                    kalman.prepare()  # so many more, and a sample brings the centres
                version, trained = message.version, trained + 1
            models.serve_late_joiners()
            process.beat(counters, now=isinstance(message, End))
            if isinstance(message, End):
                process.broken = message.failed
                break
