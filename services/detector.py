"""Frames in; tracks and features out, with the newest model there is."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import replace

from catstream.box import Box
from catstream.detection.detector import Detector
from catstream.errors import VideoError
from catstream.messages import End, Features, Model, Position, Track
from catstream.services.loop import Process
from catstream.services.previews import Previews
from catstream.video.frames import Source
from catstream.video.source import WHOLE, open_source
from catstream.wire.sockets import Publisher, Sender, Subscriber

__all__ = ["main"]

# What the last messages may take to be stored where the run was stopped.
_FAREWELL_SECONDS = 10.0
_OPEN_SECONDS = 60.0  # that opening the source may take, and learning the first frame
_SKIP_SECONDS = 0.1  # that decoding a frame may take which is passed over
_OWNER_SECONDS = 0.5  # the owner may listen no more

_log = logging.getLogger(__name__)


def main(
    process: Process,
    source: str,
    box: Box,
    *,
    resume: bool,
    owned: bool,
    recorded: bool = False,
    part: slice = WHOLE,
    since: float | None = None,
) -> None:
    """Follow the object to the last frame.

    Parameters
    ----------
    source : as `catstream.video.source.open_source` takes it
    box : of the object in the first frame
    resume : go on where a detector before this one stopped
    owned : somebody takes every track from the channel `results`
    recorded : begin once somebody listens to the tracks
    part, since : as `open_source` takes them
    """
    with ExitStack() as stack:
        line = _Line(process, stack, owned)
        if recorded:
            line.wait_for_listener()
        detector = Detector(process.settings)
        if resume:
            line.resume(detector, box)
        # From the last frame that was stored, which is passed over: there may be none after it.
        first = max(detector.seq - 1, 0)
        process.allow(_OPEN_SECONDS + first * _SKIP_SECONDS)
        frames = stack.enter_context(open_source(source, first, part=part, since=since, idle=line.idle))
        line.source = frames
        reason, failed = "the source came to its end", False
        try:
            for frame in frames:
                if frame.number < detector.seq:
                    continue
                for model in line.models.waiting():
                    detector.adopt(model)
                if detector.seq:
                    track, features = detector.step(frame.image, frame.time)
                else:
                    process.allow(_OPEN_SECONDS)
                    track, features = detector.init(frame.image, box, frame.time)
                line.send(replace(track, pts=frame.pts), features)
                line.previews.show(track.frame, frame.image, track.box)
                if not frames.live:
                    line.wait(detector)
                if process.ended:
                    break
            if process.ended:
                reason = "it was stopped"
        except VideoError as error:
            reason, failed = str(error), True
        line.end(detector.seq, reason, failed)


class _Line:
    """The detector's channels, as one.

    source : where the frames come from, once it is open; what it counts is told with the detector's health
    """

    def __init__(self, process: Process, stack: ExitStack, owned: bool) -> None:
        window, endpoint = process.settings.window, process.endpoint
        self._process = process
        self._features = stack.enter_context(Sender("features", endpoint, window))
        self._results = stack.enter_context(Sender("results", endpoint, window)) if owned else None
        self._tracks = stack.enter_context(Publisher("tracks", endpoint))
        self._lessons = stack.enter_context(Publisher("lessons", endpoint, greeting=process.run))
        self.models = stack.enter_context(Subscriber("models", endpoint))
        self.previews = stack.enter_context(Previews(endpoint))
        self._senders = [self._features] + ([self._results] if self._results else [])
        self._lockstep = process.settings.lockstep
        self._lag = 0 if self._lockstep else process.settings.lag_frames
        self._version = 0
        self.source: Source | None = None

    def wait_for_listener(self) -> None:
        """Wait until somebody listens to the tracks."""
        while not self._tracks.heard:
            self._features.listen(0.02)
            self._tracks.welcome()
            self._turn()

    def resume(self, detector: Detector, first: Box) -> None:
        """Go on after the last frame that all receivers have; from the start where there is no model yet."""
        model: Model | None = None
        while True:  # until the compressor and the trainer are of the same moment: either may have died too
            positions = [self._position(sender) for sender in self._senders]
            version = positions[0].version
            if not version or (model is not None and model.version == version):
                break
            model = self.models.receive(0.05) or model
        start = min(positions, key=lambda position: position.seq)
        if model is None or start.box is None:
            start = Position()
        else:
            detector.resume(start.seq, first, start.bearings or detector.bearings_at(start.box), model)
        for sender, position in zip(self._senders, positions, strict=True):
            sender.resume(start.seq, position.seq)

    def _position(self, sender: Sender) -> Position:
        """Where a receiver is, however long it takes."""
        while (position := sender.position()) is None:
            self._turn()
        return position

    def send(self, track: Track, features: Features) -> None:
        """Send what one frame gave; wait where a window is full."""
        self._version = track.model_version
        self._tracks.send(track)
        if self._results is not None:
            self._deliver(self._results, track)
            # Where a run can be repeated, the owner is never behind: the bearings are those of the features.
            while self._lockstep and self._results.taken < track.seq and not self._process.ended:
                self._results.listen(0.02)
                self._process.beat(self._counters)
        self._lessons.send(features)
        self._deliver(self._features, features)
        self._process.beat(self._counters)

    def wait(self, detector: Detector) -> None:
        """Wait until the frame of `lag` frames ago is taken, and for the model that it led to, or a newer one."""
        due = self._features.sent - self._lag
        while not self._process.ended:
            if self._features.taken < due:
                self._features.listen(0.02)
            elif detector.model.version < self._features.made(due):
                if (model := self.models.receive(0.02)) is not None:
                    detector.adopt(model)
                self._features.listen(0)  # a compressor may have died with the sample: it needs what led to it
            else:
                break
            self._process.beat(self._counters)

    def idle(self) -> bool:
        """Stay in touch while the source gives no frame; returns whether to wait no more."""
        for sender in self._senders:
            sender.listen(0)
        self.previews.turn()
        self._process.beat(self._counters)
        return self._process.ended

    def end(self, seq: int, reason: str, failed: bool) -> None:
        """Say that nothing follows, and wait until all is stored; where the run was stopped, not for long."""
        totals: dict[str, float] = {}
        for sender in self._senders:
            seconds = _OWNER_SECONDS if sender is self._results else _FAREWELL_SECONDS
            self._deliver(sender, End(seq + 1, reason, failed, totals), seconds)
            while sender.settled < sender.sent and not self._process.ended_for(seconds):
                sender.listen(0.02)
                self._process.beat(self._counters)
            if sender is self._features:
                totals = {"sent": float(seq), "stored": float(min(sender.stored, seq))}
        for publisher in (self._tracks, self._lessons):
            publisher.send(End(seq + 1, reason, failed, totals))
        self._process.beat(self._counters, now=True)

    def _deliver(self, sender: Sender, message: Track | Features | End, seconds: float = 0) -> None:
        """Hand a message over; where the window stays full, until this long after the run was stopped."""
        while not sender.send(message):
            sender.listen(0.02)
            self._process.beat(self._counters)
            if self._process.ended_for(seconds):
                _log.warning(
                    "message %d of %s could not be sent: its receiver is gone", message.seq, sender.channel.name
                )
                return

    def _turn(self) -> None:
        self._process.beat(self._counters)
        if self._process.ended:
            raise SystemExit(0)

    def _counters(self) -> dict[str, float]:
        return {
            "sent": self._features.sent,
            "taken": self._features.taken,
            "stored": self._features.stored,
            "model_version": self._version,
            **(self.source.counters if self.source else {}),
        }
