"""The process that compresses features in coreset trees, stores the trees on disk, and sends samples."""

from __future__ import annotations

import time
from contextlib import ExitStack

from catstream.compression.checkpoint_store import CheckpointStore
from catstream.compression.forest import Forest
from catstream.messages.kinds import End, Features
from catstream.run.learned import begun
from catstream.run.state import TREES, locked
from catstream.services.loop import Process
from catstream.services.saved_models import SavedModels
from catstream.services.stored_part import StoredPart
from catstream.services.timing import (
    CLOSE_SECONDS,
    LOCK_SECONDS,
    MESSAGE_SECONDS,
    MODEL_SECONDS,
    SENDER_SECONDS,
    STORE_SECONDS,
)
from catstream.wire.acknowledged import Receiver
from catstream.wire.channels import FEATURES, SAMPLES
from catstream.wire.newest import Publisher


def prepare() -> None:
    """Everything is imported above."""


def main(process: Process) -> None:
    """Receive each message once, until the stream ends."""
    with ExitStack() as stack:
        loop = CompressorLoop(process, stack)
        stack.callback(process.watchdog.allow, CLOSE_SECONDS)
        end: End | None = None
        while end is None and not loop.must_stop:
            message = loop.receive()
            if isinstance(message, End):
                end = message
            elif message is not None:
                loop.insert(message)
            loop.store_and_acknowledge(message)
            loop.publish_health(last=end is not None)
        if end is not None:
            process.source_failed = end.failed
            loop.end(end)
        else:
            loop.stop()


class CompressorLoop:
    """A forest, its checkpoints, and the sockets that it is connected to."""

    def __init__(self, process: Process, stack: ExitStack) -> None:
        job, settings, endpoint = process.job, process.settings, process.endpoint
        self._process = process
        self._checkpoints: CheckpointStore | None = None
        if job.state is not None:
            self._checkpoints = CheckpointStore(stack.enter_context(locked(job.state / TREES, LOCK_SECONDS)))
        self._forest = self._checkpoints.load(settings) if self._checkpoints is not None else Forest(settings)
        position = self._forest.position
        self._stored = StoredPart(position, time.monotonic())
        self._features = stack.enter_context(
            Receiver(FEATURES, endpoint, position, settings.run.unstored_frames, check=self._check)
        )
        self._samples = stack.enter_context(Publisher(SAMPLES, endpoint))
        for sample in self._forest.last_samples:
            self._samples.send(sample)
        self._saved_models = stack.enter_context(SavedModels(endpoint, settings))

    @property
    def must_stop(self) -> bool:
        """Whether the process was asked to end, and a connected detector did not send its end in time."""
        window = self._features.window
        return self._process.seconds_since_stop >= (SENDER_SECONDS if window.connected and not window.ended else 0)

    def receive(self) -> Features | End | None:
        """The next message, None if none arrives in a tenth of a second."""
        return self._features.receive(MESSAGE_SECONDS)

    def insert(self, features: Features) -> None:
        """Insert features into the trees, and send the sample if there is a new one."""
        before = self._forest.compressors.keys()
        if any(part.model for part in features.objects.values()):
            self._process.watchdog.allow(MODEL_SECONDS)
        beat = self._process.watchdog.beat  # after each object: all of them together may take long on a slow machine
        for sample in self._forest.take(features, begun(features, self._process.settings), beat):
            self._samples.send(sample)
            beat()
        if self._forest.compressors.keys() != before:
            self._samples.keep_only(self._forest.compressors)

    def store_and_acknowledge(self, message: Features | End | None) -> None:
        """Write a checkpoint if one is due, then answer position requests and acknowledge the message."""
        before, seq, window = self._stored, self._forest.seq, self._features.window
        end = message if isinstance(message, End) else None
        urgent = self._checkpoints is None or end is not None or window.half_full or window.position_requested
        interval = self._process.settings.run.checkpoint_seconds
        if (urgent and seq > before.stored) or before.is_due(seq, time.monotonic(), interval):
            self._store(urgent)
        if window.position_requested:
            self._features.answer(self._stored.position)
        if message is not None or self._stored.position is not before.position:
            self._features.acknowledge(self._stored.acknowledgement(self._forest.position, end))

    def _store(self, urgent: bool) -> None:
        """Write a checkpoint, or count all messages as stored if there are none (started by hand without --state)."""
        self._process.watchdog.allow(STORE_SECONDS)
        began = time.monotonic()
        saved = self._checkpoints is None or self._checkpoints.save(self._forest)
        now = time.monotonic()
        self._stored = self._stored.after(self._forest.position, began, now, saved=saved, urgent=urgent)

    def publish_health(self, *, last: bool = False) -> None:
        """Serve late joiners, send the trees to subscribers, and publish the health."""
        self._samples.serve_late_joiners()
        self._saved_models.turn(self._forest.compressors, self._process.watchdog.beat)
        self._process.trouble = self._checkpoints.trouble if self._checkpoints is not None else ""
        self._process.beat(self._counters, self._forest.object_counters, now=last)

    def end(self, end: End) -> None:
        """Send the end of the stream."""
        self._samples.send(end)

    def stop(self) -> None:
        """Store all received messages; the sender continues with the next compressor."""
        if self._forest.seq > self._stored.stored:
            self._store(urgent=False)
            self._features.acknowledge(self._stored.position)

    def _check(self, message: Features | End) -> None:
        """Raise ProtocolError for features of another stream."""
        if isinstance(message, Features):
            self._forest.check_features(message)

    def _counters(self) -> dict[str, float]:
        """The counters for the health of the process."""
        return self._forest.counters() | {"stored": self._stored.stored}
