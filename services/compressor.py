"""Features in, samples out; owns the coreset trees, and keeps them on disk as they grow."""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from catstream.compression.compressor import Compressor
from catstream.errors import ServiceError
from catstream.messages import End, Features, Position
from catstream.recording.file import RecordingWriter
from catstream.services.loop import Process
from catstream.services.recorder import Recorder
from catstream.wire.sockets import Publisher, Receiver

__all__ = ["main"]

_END_SECONDS = 5.0  # that the end of the tracks, after that of the features, may take

_log = logging.getLogger(__name__)


def main(process: Process, state: Path | None, record: Path | None = None) -> None:
    """Take every message once, until the stream ends.

    Parameters
    ----------
    state : folder of the checkpoint that a restarted compressor goes on from; without one,
        what was taken counts as stored
    record : file to write all that travels to, features as they are taken; one that is there is gone on with
    """
    settings = process.settings
    file = _checkpoint(state)
    compressor = Compressor.load(file, settings) if file and file.exists() else Compressor(settings)
    stored, saved = _position(compressor), time.monotonic()

    def store() -> Position:
        nonlocal stored, saved
        if file is not None:
            compressor.save(file)
        stored, saved = _position(compressor), time.monotonic()
        return stored

    def check(message: Features | End) -> None:
        if isinstance(message, Features):
            compressor.check(message)

    with ExitStack() as stack:
        recorder = None
        if record is not None:
            writer = stack.enter_context(RecordingWriter(record, process.run, resume=True))
            recorder = stack.enter_context(Recorder(writer, process.endpoint))
        features = stack.enter_context(Receiver("features", process.endpoint, stored, settings.window, store, check))
        samples = stack.enter_context(Publisher("samples", process.endpoint))

        def counters() -> dict[str, float]:
            own: dict[str, float] = {"stored": stored.seq}
            if recorder is not None:
                own |= {"recorded": writer.written, "unrecorded": float(recorder.failed != "")}
            return compressor.counters() | own

        if compressor.last_sample is not None:
            samples.send(compressor.last_sample)
        while not process.ended:
            message = features.receive(0.1)
            end = isinstance(message, End)
            if recorder is not None:
                recorder.listen()
            if message is not None and not end:
                if recorder is not None:  # before it can count as stored: none is missing that a checkpoint holds
                    recorder.keep(message)
                sample = compressor.take(message)
                if sample is not None:
                    samples.send(sample)
            before, waiting = stored.seq, compressor.seq - stored.seq
            overdue = time.monotonic() - saved >= settings.checkpoint_seconds
            if file is None or (waiting and (end or overdue or 2 * waiting >= settings.window)):
                store()
            if message is not None or stored.seq > before:
                # The end of the stream holds no features: with all before it, it is stored too. A sample needs
                # no checkpoint to be made: in lockstep the detector waits for its model.
                now = replace(stored, version=compressor.version)
                features.acknowledge(_position(compressor, message.seq) if end else now)
            samples.welcome()
            process.beat(counters, now=end)
            if end:
                samples.send(message)
                break
        deadline = time.monotonic() + _END_SECONDS
        while recorder is not None and recorder.end is None and not process.ended and time.monotonic() < deadline:
            features.receive(0.02)  # a detector that did not hear that its end is stored asks again
            recorder.listen()
            process.beat(counters)


def _checkpoint(state: Path | None) -> Path | None:
    if state is None:
        return None
    try:
        state.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ServiceError(f"cannot keep checkpoints in {state} ({error.strerror}): give another folder") from None
    return state / "compressor.safetensors"


def _position(compressor: Compressor, seq: int | None = None) -> Position:
    seq = compressor.seq if seq is None else seq
    return Position(seq, max(compressor.frame, 0), compressor.box, compressor.version, compressor.bearings)
