"""The process that compresses features in coreset trees, writes checkpoints of the trees, and sends samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from time import monotonic

from catstream.base import ridge
from catstream.base.settings import Settings
from catstream.client.saved_model import SavedModel, continued
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.coreset.compressor import Compressor
from catstream.errors import ServiceError
from catstream.processes.decisions import checkpoint_is_due, stored, sync_interval, with_end
from catstream.processes.process import MESSAGE_SECONDS, Process
from catstream.processes.state import CHECKPOINTS, locked
from catstream.wire.acknowledged import Receiver
from catstream.wire.channels import ALL_FEATURES, SAMPLES, SAVED_MODELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Features, ModelFile, Position
from catstream.wire.newest import Publisher

_LOCK_SECONDS = 10.0  # timeout for an earlier compressor to end
_SENDER_SECONDS = 5.0  # timeout after a signal for the detector to send the end of the stream
_SAVED_MODEL_SECONDS = 1.0  # minimum interval between two files of one object

ridge.prepare()  # once in the start server instead of in each process


def main(process: Process) -> None:
    """Receive each message once, until the stream ends."""
    with ExitStack() as stack:
        loop = CompressorLoop(process, stack)
        stack.callback(process.watchdog.allow)
        end: End | None = None
        while end is None and not loop.must_stop:
            message = loop.receive()
            if isinstance(message, End):
                end = message
            elif message is not None:
                loop.insert(message)
            loop.store_and_acknowledge(message)
            loop.publish(end)
        if end is None:
            loop.stop()
        else:
            process.ending.receive(end)


class CompressorLoop:
    """Connects the forest of coreset trees to its checkpoints and sockets."""

    def __init__(self, process: Process, stack: ExitStack) -> None:
        settings, endpoint = process.settings, process.endpoint
        self._process = process
        self._checkpoints = CheckpointStore(stack.enter_context(locked(process.state / CHECKPOINTS, _LOCK_SECONDS)))
        self._forest = self._checkpoints.load(settings)
        self._forest.skip_to(process.job.first)
        seq = self._forest.seq
        self._position = Position(seq, seq, versions=self._forest.versions)
        self._tried = monotonic()  # time of the last attempt to write a checkpoint
        self._took = 0.0  # duration of the last checkpoint that was not synced
        self._sync_at = 0.0  # time from which the next checkpoint is synced
        check, states, window = self._check, self._forest.states_at, settings.run.unstored_frames
        self._features = stack.enter_context(Receiver(ALL_FEATURES, endpoint, self._position, window, check, states))
        self._samples = stack.enter_context(Publisher(SAMPLES, endpoint))
        for sample in self._forest.last_samples:
            self._samples.send(sample)
        self._saved_models = stack.enter_context(SavedModels(endpoint, settings))

    @property
    def must_stop(self) -> bool:
        """True after a signal, once a connected detector has had its time to send the end of the stream."""
        window = self._features.window
        seconds = _SENDER_SECONDS if window.connected and not window.ended else 0
        return self._process.ending.seconds_since_signal >= seconds

    def receive(self) -> Features | End | None:
        """The next message, None after a timeout."""
        return self._features.receive(MESSAGE_SECONDS)

    def insert(self, features: Features) -> None:
        """Insert features into the trees, and send the sample if there is a new one."""
        before = self._forest.compressors.keys()
        if any(part.model for part in features.objects.values()):
            self._process.watchdog.allow()
        beat = self._process.watchdog.beat  # after each object: on a slow machine, all objects may exceed the limit
        for sample in self._forest.take(features, continued(features, self._process.settings), beat):
            self._samples.send(sample)
            beat()
        if self._forest.compressors.keys() != before:
            self._samples.keep_only(self._forest.compressors)

    def store_and_acknowledge(self, message: Features | End | None) -> None:
        """Write a checkpoint if one is due, then acknowledge the message, with the newest samples."""
        before, seq = self._position, self._forest.seq
        is_end = isinstance(message, End)
        features = self._features
        urgent = is_end or features.window.half_full or bool(features.pending_restarts)
        interval = self._process.settings.run.checkpoint_seconds
        if seq > self._stored and (urgent or checkpoint_is_due(monotonic() - self._tried, self._took, interval)):
            self._store(urgent, is_end)
        if message is not None or self._position is not before:
            # Announce samples before their checkpoint: in lockstep, the detector waits for their models.
            position = replace(self._position, processed=seq, versions=self._forest.versions)
            features.acknowledge(with_end(position, message.seq) if isinstance(message, End) else position)
        features.answer()

    @property
    def _stored(self) -> int:
        """Number of the newest message in a checkpoint."""
        return self._position.seq - self._position.in_memory

    def _store(self, urgent: bool, is_end: bool) -> None:
        self._process.watchdog.allow()
        began = monotonic()
        durable = self._process.job.state is not None and (is_end or began >= self._sync_at)
        saved = self._checkpoints.save(self._forest, durable=durable)
        self._tried = monotonic()
        if saved and durable:  # do not measure it: the next one is not synced
            self._sync_at = began + sync_interval(self._checkpoints.size)
        else:
            self._took = self._tried - began
        self._position = stored(self._position, self._forest.seq, saved=saved, urgent=urgent)

    def publish(self, end: End | None) -> None:
        """Serve late joiners, send the trees and the end to subscribers, and publish the health."""
        if end is not None:
            self._samples.send(end)
        self._samples.serve_late_joiners()
        self._saved_models.serve(self._forest.compressors, self._process.watchdog.beat)
        self._process.trouble = self._checkpoints.trouble
        self._process.beat(self._counters, self._forest.object_counters, now=end is not None)

    def stop(self) -> None:
        """Write a final checkpoint and acknowledge it; the sender continues with the next compressor."""
        if self._forest.seq > self._stored:
            self._store(urgent=False, is_end=True)
            self._features.acknowledge(
                replace(self._position, processed=self._forest.seq, versions=self._forest.versions)
            )

    def _check(self, message: Features | End) -> None:
        """Raise ProtocolError for features of another stream."""
        if isinstance(message, Features):
            self._forest.check_features(message)

    def _counters(self) -> dict[str, float]:
        counters, problem = self._forest.counters() | {"stored": self._stored}, self._checkpoints.write_problem
        return counters if problem is None else counters | {"write_failed": float(bool(problem))}


class SavedModels(Publisher[ModelFile]):
    """Publishes the trees of each object after each new sample, at most once a second, if there are subscribers."""

    def __init__(self, endpoint: Endpoint, settings: Settings) -> None:
        super().__init__(SAVED_MODELS, endpoint)
        self._settings = settings
        self._sent: dict[str, tuple[int, float]] = {}  # version and time of the last file of each object

    def serve(self, compressors: Mapping[str, Compressor], after_each: Callable[[], object]) -> None:
        """Send pending files, and call `after_each` after each. Call once per iteration, to serve new subscribers."""
        self.serve_late_joiners()
        if not self.has_subscribers:
            if self._sent:  # late joiners receive new files only
                self._sent.clear()
                self.keep_only(())
            return
        for name, compressor in compressors.items():
            version, moment = self._sent.get(name, (0, 0.0))
            if compressor.version > version and (not version or monotonic() - moment >= _SAVED_MODEL_SECONDS):
                self._send(name, compressor)
                after_each()

    def _send(self, name: str, compressor: Compressor) -> None:
        try:
            saved = SavedModel.of(compressor, self._settings)
        except ServiceError:  # the object of a saved model was not detected yet
            return
        self.send(ModelFile(compressor.version, saved.to_bytes(), name))
        self._sent[name] = compressor.version, monotonic()
