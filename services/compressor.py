"""Features in, samples out; owns the coreset trees, and keeps them on disk as they grow."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from catstream.compression import reduce
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.compression.compressor import Compressor
from catstream.learned import Learned
from catstream.messages import End, Features, Position
from catstream.recording.file import RecordingWriter
from catstream.services.loop import Process
from catstream.services.recorder import Recorder
from catstream.state import TREES, locked
from catstream.wire.acknowledged import Receiver
from catstream.wire.channels import FEATURES, SAMPLES
from catstream.wire.newest import Publisher

__all__ = ["main"]

_FAREWELL_SECONDS = 5.0  # that the sender may take to end where all were asked to
_END_SECONDS = 5.0  # that the end of the tracks, after that of the features, may take
_STORE_SECONDS = 60.0  # that a slow disk may take
_READ_SECONDS = 1e-7  # that it may take for a byte
_LOCK_SECONDS = 10.0  # that a compressor before this one may take to end


def main(process: Process) -> None:
    """Take every message once, until the stream ends.

    Parameters
    ----------
    model : file of what was learned of the object before: the trees go on from it
    state : folder of the checkpoints that a restarted compressor goes on from; without one,
        what was taken counts as stored
    record : file to write all that travels to, features as they are taken; one that is there is gone on with
    """
    settings, job = process.settings, process.job
    model, state, record = job.model, job.state, job.record
    with ExitStack() as stack:
        checkpoints = None
        if state is not None:
            checkpoints = CheckpointStore(stack.enter_context(locked(state / TREES, _LOCK_SECONDS)))
        compressor = checkpoints.load(settings) if checkpoints else Compressor(settings)
        if model is not None and not compressor.seq:
            compressor = Compressor.of(Learned.load(model).sample, settings)
        stored, tried, settled = compressor.seq, time.monotonic(), compressor.position

        def store(needed: bool = True) -> Position:
            """Write a checkpoint. Where the disk takes none and it is needed, memory has to do: learning goes on."""
            nonlocal stored, tried, settled
            process.allow(_STORE_SECONDS)
            if checkpoints is None or checkpoints.save(compressor):
                stored, needed = compressor.seq, True
            tried = time.monotonic()
            if needed:
                settled = replace(compressor.position, unsaved=compressor.seq - stored)
            return settled

        recorder = None
        if record is not None:
            process.allow(reading_seconds(record))
            writer = stack.enter_context(RecordingWriter(record, process.run, resume=True))
            recorder = stack.enter_context(Recorder(writer, process.endpoint))

        def check(message: Features | End) -> None:
            if isinstance(message, Features):
                compressor.check(message)

        features = stack.enter_context(
            Receiver(FEATURES, process.endpoint, settled, settings.run.unstored_frames, check)
        )
        samples = stack.enter_context(Publisher(SAMPLES, process.endpoint))

        def counters() -> dict[str, float]:
            own: dict[str, float] = {"stored": stored}
            if recorder is not None:
                own |= {"recorded": writer.written, "unrecorded": float(recorder.failed != "")}
            return compressor.counters() | own

        if compressor.last_sample is not None:
            samples.send(compressor.last_sample)
        end = False
        while not process.ended_for(_FAREWELL_SECONDS if features.has_sender else 0):
            message = features.receive(0.1)
            end = isinstance(message, End)
            if message is None:
                reduce.prepare()
            if recorder is not None:
                recorder.listen()
            if isinstance(message, Features):
                if recorder is not None:  # before it can count as stored: none is missing that a checkpoint holds
                    recorder.keep(message)
                sample = compressor.take(message)
                if sample is not None:
                    samples.send(sample)
            before, waiting = settled, compressor.seq - settled.seq
            needed = checkpoints is None or end or 2 * waiting >= settings.run.unstored_frames or features.asked
            overdue = time.monotonic() - tried >= settings.run.checkpoint_seconds
            if compressor.seq > stored and (needed or overdue):
                store(needed)
            if features.asked:
                features.answer(settled)
            if message is not None or settled is not before:
                # The end of the stream holds no features: with all before it, it is stored too. A sample needs
                # no checkpoint to be made: in lockstep the detector waits for its model.
                now = replace(settled, version=compressor.sampled)
                if isinstance(message, End):
                    now = replace(now, seq=message.seq, unsaved=now.unsaved and now.unsaved + 1)
                features.acknowledge(now)
            samples.serve_late_joiners()
            process.trouble = checkpoints.trouble if checkpoints else ""
            process.beat(counters, now=end)
            if isinstance(message, End):
                process.broken = message.failed
                samples.send(message)
                break
        else:
            if compressor.seq > stored:  # who goes on sending has nothing of it to repeat
                features.acknowledge(store(needed=False))
        deadline = time.monotonic() + _END_SECONDS
        while end and recorder is not None and recorder.end is None and time.monotonic() < deadline:
            features.receive(0.02)  # a detector that did not hear that its end is stored asks again
            recorder.listen()
            process.beat(counters)


def reading_seconds(file: Path) -> float:
    """Limit for opening a recording, which is read to its last whole message."""
    return _STORE_SECONDS + (file.stat().st_size if file.exists() else 0) * _READ_SECONDS
