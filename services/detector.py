"""Frames in; tracks and features out, with the newest model there is."""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from catstream import kalman
from catstream.box import Box
from catstream.detection.detector import Detector
from catstream.errors import ProtocolError, VideoError
from catstream.learned import Learned
from catstream.messages import End, Features, Model, Position, Track
from catstream.services.commands import CommandHandler, DesiredState
from catstream.services.loop import Process
from catstream.services.previews import Previews
from catstream.video.ahead import read_ahead
from catstream.video.frames import Frame, Source, without_password
from catstream.video.source import ALL_FRAMES, open_source
from catstream.wire.announced import readers_of
from catstream.wire.sockets import Publisher, Sender, Subscriber

__all__ = ["main"]

# What the last messages may take to be stored where the run was stopped.
_FAREWELL_SECONDS = 10.0
_OPEN_SECONDS = 60.0  # that opening the source may take, and learning the first frame
_SKIP_SECONDS = 0.1  # that decoding a frame may take which is passed over
_HELD_SECONDS = 0.02  # from one look at the commands to the next while a frame is held
_LONGEST_SOURCE = 1000  # characters of it that are told with the health
_SUBSCRIBERS_SECONDS = 5.0  # that subscribers that wait for this pipeline may take to connect
_OWNER_SECONDS = 0.5  # the owner may listen no more

_log = logging.getLogger(__name__)


def main(
    process: Process,
    source: str,
    box: Box | None,
    model: Path | None,
    *,
    resume: bool,
    owned: bool,
    recorded: bool = False,
    state: Path | None = None,
    part: slice = ALL_FRAMES,
    since: float | None = None,
) -> None:
    """Follow the object to the last frame.

    Parameters
    ----------
    source : as `catstream.video.source.open_source` takes it
    box : of the object in the first frame
    model : file of what was learned of the object before, which is then searched for; without this or a box,
        it waits until a box is commanded
    resume : go on where a detector before this one stopped
    owned : somebody takes every track from the channel `results`
    recorded : begin once somebody listens to the tracks
    state : folder in which what was commanded is kept, for a detector after this one
    part, since : as `open_source` takes them
    """
    process.source = _shown(source)
    with ExitStack() as stack:
        learned = Learned.load(model) if model is not None else None
        file = state / "desired_state.json" if state is not None else None
        desired = DesiredState(box, begins=1) if box is not None else DesiredState(learned.box if learned else None)
        if resume and file is not None and file.exists():
            try:
                desired = DesiredState.load(file)
            except ProtocolError as error:  # what was learned is whole, and goes on
                process.trouble = str(error)
                _log.warning("%s", error)
        detector = Detector(process.settings)
        commands = stack.enter_context(CommandHandler(process.endpoint, detector, desired, file))
        line = _Line(process, stack, commands, owned)
        line.wait_for_subscribers(recorded)
        if resume:
            kalman.prepare()  # while the others say where they are
            line.resume(detector, learned)
        elif learned is not None:
            detector.seek(learned.model, learned.box)
        # From the last frame that was stored, which is passed over: there may be none after it.
        first, step = max(detector.seq - 1, 0), part.step or 1
        process.allow(_OPEN_SECONDS + ((part.start or 0) + first * step) * _SKIP_SECONDS)
        process.allow_each((step - 1) * _SKIP_SECONDS)
        frames = stack.enter_context(
            open_source(
                source,
                first,
                part=part,
                since=since,
                idle=line.idle,
                image_rate=process.settings.run.image_rate,
                skip_damaged=process.settings.run.skip_damaged,
            )
        )
        line.source = frames
        coming = frames if frames.live else stack.enter_context(closing(read_ahead(frames)))
        reason, failed = "the source came to its end", False
        try:
            for frame in coming:
                if frame.number < detector.seq:
                    continue
                found = line.held(frame, detector.seq)
                if line.over:
                    break
                if found is None and commands.holds:
                    line.skipped += 1
                    continue
                if found is None:
                    line.adopt(detector)
                    if detector.seq < max(commands.desired.begins, 1):
                        process.allow(_OPEN_SECONDS)
                    found = _follow(detector, frame, commands.desired)
                track, features = found
                line.send(replace(track, pts=frame.pts), features)
                if track.frame >= process.settings.search.motion_frames // 2:
                    kalman.prepare()  # so many more, and a model brings the motion
                line.previews.show(track.frame, frame.image, track.box)
                if not frames.live:
                    line.wait(detector)
                if line.over:
                    break
            reason = line.over or reason
        except VideoError as error:
            reason, failed = str(error), True
        line.end(detector.seq, reason, failed)
        process.broken = failed
        if failed:
            _log.error("%s", reason)


def _shown(source: str) -> str:
    """A source as anyone may read it: of an address neither user, password nor query, in which cameras take them too.

    >>> _shown("http://me:secret@10.0.0.7/video.mjpg?pwd=secret")
    'http://10.0.0.7/video.mjpg'
    """
    text = without_password(source)
    if "://" in text:
        text = text.partition("?")[0]
    return text.encode(errors="replace").decode()[:_LONGEST_SOURCE]  # the name of a file may be no text


def _follow(detector: Detector, frame: Frame, desired: DesiredState) -> tuple[Track, Features]:
    """What a frame gives that was not followed before, by this detector or the one before it."""
    seq = detector.seq + 1
    if seq < desired.begins:  # of the object before, of which all is forgotten; only its owner lacks these tracks
        return detector.miss(frame.time)
    if seq == desired.begins and desired.box is not None:
        return detector.init(frame.image, desired.box, frame.time)
    return detector.step(frame.image, frame.time)


class _Line:
    """The detector's channels, as one.

    source : where the frames come from, once it is open; what it counts is told with the detector's health
    skipped : frames of it that were taken, and not followed as that is not wanted now
    """

    def __init__(self, process: Process, stack: ExitStack, commands: CommandHandler, owned: bool) -> None:
        window, endpoint = process.settings.run.unstored_frames, process.endpoint
        self._process, self._commands = process, commands
        self._features = stack.enter_context(Sender("features", endpoint, window))
        self._results = stack.enter_context(Sender("results", endpoint, window)) if owned else None
        self._tracks = stack.enter_context(Publisher("tracks", endpoint))
        self._lessons = stack.enter_context(Publisher("lessons", endpoint, greeting=process.run))
        self.models = stack.enter_context(Subscriber("models", endpoint))
        self.previews = stack.enter_context(Previews(endpoint))
        self._senders = [self._features] + ([self._results] if self._results else [])
        self._lockstep = process.settings.run.lockstep
        self._lag = 0 if self._lockstep else process.settings.run.lag_frames
        self._version = 0
        self.source: Source | None = None
        self.skipped = 0

    @property
    def over(self) -> str:
        """Why no frame is followed any more, empty before."""
        return "it was stopped" if self._process.ended else self._commands.over

    def wait_for_subscribers(self, recorded: bool) -> None:
        """Wait for the recorder, however long it takes, and a few seconds for subscribers that announced themselves."""
        publishers = {"tracks": self._tracks, "lessons": self._lessons}
        for channel, readers in readers_of(self._process.endpoint).items():
            if channel in publishers:
                publishers[channel].expect(readers)
        deadline = time.monotonic() + _SUBSCRIBERS_SECONDS
        while (recorded and not self._tracks.heard) or (
            time.monotonic() < deadline and not all(publisher.complete for publisher in publishers.values())
        ):
            self._features.listen(0.02)
            for publisher in publishers.values():
                publisher.welcome()
            self._turn()

    def resume(self, detector: Detector, learned: Learned | None) -> None:
        """Go on after the last frame that all receivers have; from the object's first where there is no model of it."""
        model: Model | None = None
        while True:  # until the compressor and the trainer are of the same moment: either may have died too
            positions = [self._position(sender) for sender in self._senders]
            version = positions[0].version
            if not version or (model is not None and model.version == version):
                break
            model = self.models.receive(0.05) or model
        start = min(positions, key=lambda position: position.seq)
        first, begins = self._commands.desired.box, max(self._commands.desired.begins, 1)
        if not version:
            start = Position(min(start.seq, begins - 1))
        state = start.detector
        if state is None and start.box is not None and first is not None:
            state = detector.state_at(start.box, first)
        if start.seq >= begins and state is not None and model is not None:
            detector.resume(start.seq, state, model)
        else:
            detector.seq = start.seq
            if learned is not None and not self._commands.desired.begins:
                detector.seek(learned.model, learned.box)
        for sender, position in zip(self._senders, positions, strict=True):
            sender.resume(start.seq, position.seq)

    def _position(self, sender: Sender) -> Position:
        """Where a receiver is, however long it takes."""
        while (position := sender.position()) is None:
            self._turn()
        return position

    def adopt(self, detector: Detector) -> None:
        """Take in whatever models have come."""
        for model in self.models.waiting():
            detector.adopt(model)

    def held(self, frame: Frame, number: int) -> tuple[Track, Features] | None:
        """What the frame gives by a box that was commanded for it; of a file it is held for as long as is wanted."""
        self._beat()
        found = self._begun(frame)
        if found is None and self._commands.holds:
            self.previews.show(number, frame.image, None)
            while found is None and self._waits:
                time.sleep(_HELD_SECONDS)
                self.idle()
                found = self._begun(frame)
        return found

    def _begun(self, frame: Frame) -> tuple[Track, Features] | None:
        if self._commands.wanted:
            self._process.allow(_OPEN_SECONDS)
        return self._commands.follow(frame)

    def send(self, track: Track, features: Features) -> None:
        """Send what one frame gave; wait where a window is full."""
        self._version = track.model_version
        self._tracks.send(track)
        if self._results is not None:
            self._deliver(self._results, track)
            # Where a run can be repeated, the owner is never behind: the detector state is that of the features.
            while self._lockstep and self._results.taken < track.seq and not self._process.ended:
                self._results.listen(0.02)
                self._beat()
        self._lessons.send(features)
        self._deliver(self._features, features)

    def wait(self, detector: Detector) -> None:
        """Wait until the frame of `lag` frames ago is taken, and for the model that it led to, or a newer one."""
        due = self._features.sent - self._lag
        while not self.over:
            if self._features.taken < due:
                self._features.listen(0.02)
            elif detector.heard < self._features.made(due):
                if (model := self.models.receive(0.02)) is not None:
                    detector.adopt(model)
                self._features.listen(0)  # a compressor may have died with the sample: it needs what led to it
            else:
                break
            self._beat()

    def idle(self) -> bool:
        """Stay in touch while there is no frame to follow; returns whether to wait no more."""
        for sender in self._senders:
            sender.listen(0)
        self.previews.turn()
        self._beat()
        if self.source is not None and self.source.counters.get("lost_seconds"):
            self._commands.refuse_boxes("the source is lost, so there is no frame for a box: ask again once it is back")
        return bool(self.over)

    def end(self, seq: int, reason: str, failed: bool) -> None:
        """Say that nothing follows, and wait until all is stored; where the run was stopped, not for long."""
        self._commands.end(reason)
        totals: dict[str, float] = {}
        for sender in self._senders:
            seconds = _OWNER_SECONDS if sender is self._results else _FAREWELL_SECONDS
            self._deliver(sender, End(seq + 1, reason, failed, totals), seconds)
            while sender.settled < sender.sent and not self._process.ended_for(seconds):
                sender.listen(0.02)
                self._beat()
            if sender is self._features:
                totals = {"sent": float(seq), "stored": float(min(sender.stored, seq))}
        self._commands.release()
        for publisher in (self._tracks, self._lessons):
            publisher.send(End(seq + 1, reason, failed, totals))
        self._process.beat(self._counters, now=True)

    def _deliver(self, sender: Sender, message: Track | Features | End, seconds: float = 0) -> None:
        """Hand a message over; where the window stays full, until this long after the run was stopped."""
        while not sender.send(message):
            sender.listen(0.02)
            self._beat()
            if self._process.ended_for(seconds):
                _log.warning(
                    "message %d of %s could not be sent: its receiver is gone", message.seq, sender.channel.name
                )
                return

    def _turn(self) -> None:
        self._beat()
        if self._process.ended:
            raise SystemExit(0)

    @property
    def _waits(self) -> bool:
        """Whether a frame in hand waits; one of a live source does not."""
        return self._commands.holds and not self.over and self.source is not None and not self.source.live

    def _beat(self) -> None:
        self._process.beat(self._counters, now=self._commands.listen())

    def _counters(self) -> dict[str, float]:
        counters = self.source.counters if self.source else {}
        if "skipped" in counters:
            counters["skipped"] += self.skipped
        return {
            "sent": self._features.sent,
            "taken": self._features.taken,
            "stored": self._features.stored,
            "model_version": self._version,
            **self._commands.counters,
            **counters,
        }
