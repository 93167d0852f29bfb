"""Frames in; tracks and features out, with the newest model.

`main` is the order of events, and `DetectorLoop` connects them to sockets. What is decided on the way is decided by
`resume`, `pacing`, `delivery` and `commands`, which know no socket.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import Any, TypeVar

from catstream import kalman
from catstream.detection.detector import Detector
from catstream.errors import ProtocolError, VideoError
from catstream.learned import Learned
from catstream.messages import End, Features, Model, Position, Track
from catstream.services.commands import CommandHandler
from catstream.services.control import CommandChannel
from catstream.services.delivery import Step, next_step
from catstream.services.desired import DesiredState
from catstream.services.loop import Process
from catstream.services.outputs import Outputs
from catstream.services.pacing import Awaited, awaited
from catstream.services.resume import agree, start
from catstream.video.ahead import read_ahead
from catstream.video.frames import Frame, Source, without_password
from catstream.video.source import open_source
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import MODELS
from catstream.wire.newest import Subscriber

__all__ = ["main", "opening_seconds"]

Message = TypeVar("Message", bound=Track | Features | End)

_FILE = "desired_state.json"  # in the folder of the state
_COMPRESSOR_SECONDS = 10.0  # time for the compressor to store the end, once the process was asked to end
_OWNER_SECONDS = 0.5  # the same for the owner of the run, which may no longer receive
_OPEN_SECONDS = 60.0  # limit for opening the source, and for learning the first frame
_SKIP_SECONDS = 0.1  # limit for decoding a frame that is passed over
_TURN_SECONDS = 0.02  # from one turn of a waiting loop to the next
_SUBSCRIBERS_SECONDS = 5.0  # limit for the subscribers that wait for this pipeline to connect
_LONGEST_SOURCE = 1000  # characters of the source that are published with the health

_log = logging.getLogger(__name__)


def main(process: Process) -> None:
    """Follow the object of the job to the last frame of its source."""
    process.source = _shown(process.job.source)
    learned = Learned.load(process.job.model) if process.job.model is not None else None
    reason, failed = "the source came to its end", False
    with ExitStack() as stack:
        loop = DetectorLoop(process, stack, learned)
        loop.wait_for_subscribers()
        if process.job.resume:
            loop.resume(learned)
        elif learned is not None:
            loop.detector.seek(learned.model, learned.box)
        frames = loop.open(stack)
        try:
            for frame in frames:
                found = loop.follow(frame)
                if found is not None:
                    loop.send(frame, *found)
                    loop.wait_for_model()
                if loop.over:
                    break
            reason = loop.over or reason
        except VideoError as error:
            reason, failed = str(error), True
        loop.end(reason, failed)
        process.broken = failed
        if failed:
            _log.error("%s", reason)


class DetectorLoop:
    """A detector, and the sockets that it is connected to.

    Every method that waits does so in turns: see `turn`.
    """

    def __init__(self, process: Process, stack: ExitStack, learned: Learned | None) -> None:
        state = process.job.state
        file = state / _FILE if state is not None else None
        self.detector = Detector(process.settings)
        self._process = process
        self._commands = CommandHandler(self.detector, _desired(process, learned))
        self._control = stack.enter_context(CommandChannel(process.endpoint, self._commands, file))
        self._outputs = stack.enter_context(Outputs(process))
        self._models = stack.enter_context(Subscriber(MODELS, process.endpoint))
        self._source: Source | None = None
        self._skipped = 0  # frames that were passed over because the run is paused or waits for a box
        self._version = 0  # of the model of the last track

    @property
    def over(self) -> str:
        """Why no frame is followed any more, empty before that."""
        return "it was stopped" if self._process.ended else self._commands.over

    def turn(self, sender: Sender[Any] | None = None) -> None:
        """One turn of a waiting loop: take in acknowledgements, then `attend`.

        It waits a short time for the acknowledgements of a sender, if one is given.
        """
        self._outputs.poll(sender)
        self.attend()

    def attend(self) -> None:
        """Serve late joiners, carry out the commands that have arrived, and publish the health."""
        self._outputs.serve_late_joiners()
        commanded = self._control.carry_out()
        self._process.beat(self._counters, now=commanded)

    def wait_for_subscribers(self) -> None:
        """Wait for the recorder, as long as it takes, and for announced subscribers, for a few seconds."""
        recorded = self._process.job.record is not None
        deadline = time.monotonic() + _SUBSCRIBERS_SECONDS
        while (recorded and not self._outputs.has_subscribers) or (
            not self._outputs.all_connected and time.monotonic() < deadline
        ):
            self._outputs.poll(self._outputs.features)
            self._attend_or_exit()

    def resume(self, learned: Learned | None) -> None:
        """Go on after the last message that all receivers have stored."""
        kalman.prepare()  # while the others answer
        model: Model | None = None
        positions = [self._position(sender) for sender in self._outputs.senders]
        while not agree(positions[0], model):
            model = self._models.receive(_TURN_SECONDS) or model
            positions = [self._position(sender) for sender in self._outputs.senders]
        desired, detector = self._commands.desired, self.detector
        begin = start(positions, model, desired, detector.state_at)
        if begin.detector is not None and begin.model is not None:
            detector.resume(begin.seq, begin.detector, begin.model)
        else:
            detector.seq = begin.seq
            if learned is not None and not desired.begins:
                detector.seek(learned.model, learned.box)
        for sender, position in zip(self._outputs.senders, positions, strict=True):
            sender.resume(begin.seq, position.seq)

    def _position(self, sender: Sender[Any]) -> Position:
        """The answer of a receiver, however long it takes."""
        while (position := sender.ask_position()) is None:  # no `poll`, which would take the answer
            self._attend_or_exit()
        return position

    def _attend_or_exit(self) -> None:
        """One turn before the first frame: nothing was sent yet, so the process may end at once."""
        self.attend()
        if self._process.ended:
            raise SystemExit(0)

    def open(self, stack: ExitStack) -> Iterator[Frame]:
        """Open the source. The frame before the first one wanted is read too: there may be none after it."""
        job, settings = self._process.job, self._process.settings
        first = max(self.detector.seq - 1, 0)
        once, each = opening_seconds(job.part, first)
        self._process.allow(once)
        self._process.allow_each(each)
        self._source = stack.enter_context(
            open_source(
                job.source,
                first,
                part=job.part,
                since=job.since,
                idle=self._idle,
                image_rate=settings.run.image_rate,
                skip_damaged=settings.run.skip_damaged,
            )
        )
        return self._source if self._source.live else stack.enter_context(closing(read_ahead(self._source)))

    def _idle(self) -> bool:
        """One turn while a live source gives no frame; returns whether to wait no longer."""
        self.turn()
        if self._source is not None and self._source.counters.get("lost_seconds"):
            self._control.reject_boxes("the source is lost, so there is no frame for a box: ask again once it is back")
        return bool(self.over)

    def follow(self, frame: Frame) -> tuple[Track, Features] | None:
        """The track and the features of a frame; None if it is passed over."""
        if frame.number < self.detector.seq:
            return None
        self.turn()
        found = self._begin(frame) or self._hold(frame)
        if found is not None or self.over:
            return found
        if self._commands.desired.holds:
            self._skipped += 1
            return None
        return self._step(frame)

    def _hold(self, frame: Frame) -> tuple[Track, Features] | None:
        """Wait with a frame in hand while the run is paused or has no box; one of a live source is not held."""
        if self._commands.desired.holds:
            self._outputs.show(self.detector.seq, frame.image, None)
        live = self._source is not None and self._source.live
        while self._commands.desired.holds and not self.over and not live:
            time.sleep(_TURN_SECONDS)
            self.turn()
            if (found := self._begin(frame)) is not None:
                return found
        return None

    def _begin(self, frame: Frame) -> tuple[Track, Features] | None:
        """The track and the features of a frame in which a command gave the box."""
        if self._commands.has_box:
            self._process.allow(_OPEN_SECONDS)
        return self._control.begin(frame)

    def _step(self, frame: Frame) -> tuple[Track, Features]:
        """The track and the features of a frame that is followed for the first time, or once more after a restart."""
        detector, desired, seq = self.detector, self._commands.desired, self.detector.seq + 1
        for model in self._models.receive_all():
            detector.adopt(model)
        if seq <= max(desired.begins, 1):
            self._process.allow(_OPEN_SECONDS)
        if seq < desired.begins:  # a frame of the object before, which is forgotten: only the owner lacks its track
            return detector.miss(frame.time)
        if seq == desired.begins and desired.box is not None:
            return detector.init(frame.image, desired.box, frame.time)
        return detector.step(frame.image, frame.time)

    def send(self, frame: Frame, track: Track, features: Features) -> None:
        """Send what one frame gave; wait while a window is full."""
        track = replace(track, pts=frame.pts)
        self._version = track.model_version
        self._outputs.publish_track(track)
        if (results := self._outputs.results) is not None:
            self._deliver(results, track)
            # In lockstep the owner is never behind: after a crash, all go on after the same message.
            while self._process.settings.run.lockstep and results.taken < track.seq and not self._process.ended:
                self.turn(results)
        self._outputs.publish_features(features)
        self._deliver(self._outputs.features, features)
        self._outputs.show(track.frame, frame.image, track)
        if track.frame >= self._process.settings.search.motion_frames // 2:
            kalman.prepare()  # after as many frames more, a model brings the motion

    def wait_for_model(self) -> None:
        """Wait until learning is no further behind than it may be: see `catstream.services.pacing`."""
        settings, features = self._process.settings, self._outputs.features
        due = features.sent - (0 if settings.run.lockstep else settings.run.lag_frames)
        live = self._source is not None and self._source.live
        while not live and not self.over:
            match awaited(due, features.taken, features.sample_of(due), self.detector.newest_version):
                case Awaited.NOTHING:
                    return
                case Awaited.TAKEN:
                    self.turn(features)
                case Awaited.MODEL:  # a compressor that died with the sample needs the features again: hence the turn
                    if (model := self._models.receive(_TURN_SECONDS)) is not None:
                        self.detector.adopt(model)
                    self.turn()

    def end(self, reason: str, failed: bool) -> None:
        """Send the end of the stream, and wait until it is stored; not for long, if the process was asked to end."""
        self._control.end(reason)
        features, results, seq = self._outputs.features, self._outputs.results, self.detector.seq
        self._deliver(features, End(seq + 1, reason, failed), _COMPRESSOR_SECONDS, stored=True)
        end = End(seq + 1, reason, failed, {"sent": float(seq), "stored": float(min(features.stored, seq))})
        if results is not None:
            self._deliver(results, end, _OWNER_SECONDS, stored=True)
        self._control.release()
        self._outputs.publish_track(end)
        self._outputs.publish_features(end)
        self._process.beat(self._counters, now=True)

    def _deliver(
        self, sender: Sender[Message], message: Message, patience: float = 0.0, *, stored: bool = False
    ) -> None:
        """Send a message on an acknowledged channel, and wait until its window takes it, or until it is stored."""
        sent = sender.send(message)
        while True:
            step = next_step(
                sent=sent,
                stored=not stored or sender.acknowledged >= message.seq,
                asked_seconds=self._process.asked_seconds,
                patience_seconds=patience,
            )
            match step:
                case Step.DONE:
                    return
                case Step.GIVE_UP:
                    if not sent:
                        gone = "message %d of %s could not be sent: its receiver is gone"
                        _log.warning(gone, message.seq, sender.channel.name)
                    return
                case Step.WAIT:
                    self.turn(sender)
                case Step.SEND:
                    self.turn(sender)
                    sent = sender.send(message)

    def _counters(self) -> dict[str, float]:
        """The counters for the health of the process."""
        counters = self._source.counters if self._source is not None else {}
        if "skipped" in counters:
            counters["skipped"] += self._skipped
        features = self._outputs.features
        own = {
            "sent": features.sent,
            "taken": features.taken,
            "stored": features.stored,
            "model_version": self._version,
        }
        return own | self._commands.counters | counters


def opening_seconds(part: slice, first: int) -> tuple[float, float]:
    """Limits for opening a source at frame `first` of a part, and for what each frame takes more than usual."""
    step = part.step or 1
    return _OPEN_SECONDS + ((part.start or 0) + first * step) * _SKIP_SECONDS, (step - 1) * _SKIP_SECONDS


def _desired(process: Process, learned: Learned | None) -> DesiredState:
    """The desired state at the start: the one that was kept, if the run goes on, otherwise that of the job."""
    job = process.job
    if job.resume and job.state is not None and (job.state / _FILE).exists():
        try:
            return DesiredState.load(job.state / _FILE)
        except ProtocolError as error:  # everything that was learned is whole, and is gone on with
            process.trouble = str(error)
            _log.warning("%s", error)
    if job.box is not None:
        return DesiredState(job.box, begins=1)
    return DesiredState(learned.box if learned is not None else None)


def _shown(source: str) -> str:
    """A source as anybody may read it: an address loses user, password, and the query, which may contain them too.

    >>> _shown("http://me:secret@10.0.0.7/video.mjpg?pwd=secret")
    'http://10.0.0.7/video.mjpg'
    """
    text = without_password(source)
    if "://" in text:
        text = text.partition("?")[0]
    return text.encode(errors="replace").decode()[:_LONGEST_SOURCE]  # the name of a file may not be UTF-8
