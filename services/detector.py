"""The process that tracks the objects in each frame with their newest models, and sends tracks and features.

`main` shows the order of events, and `DetectorLoop` connects them to sockets. The decisions are pure functions in
`resume`, `pacing`, `delivery` and `commands`.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import TypeVar

import cv2

from catstream.detection import objects
from catstream.detection.detector import Detector, Result
from catstream.detection.objects import Detectors
from catstream.errors import ProtocolError, VideoError
from catstream.features.pyramid import Pyramid
from catstream.messages import storage
from catstream.messages.kinds import End, Features, Model, Position, Tracks
from catstream.numerics import ridge
from catstream.run.learned import Learned
from catstream.run.state import SEARCHED
from catstream.services.commands import CommandHandler
from catstream.services.control import CommandChannel
from catstream.services.delivery import Step, next_step
from catstream.services.desired import DesiredObject, DesiredState
from catstream.services.loop import RECORDER, Process
from catstream.services.model_files import ModelFiles
from catstream.services.outputs import DataSender, Outputs
from catstream.services.pacing import Awaited, awaited
from catstream.services.resume import agree, start
from catstream.video import source
from catstream.video.ahead import read_ahead
from catstream.video.frames import Frame, Source, without_password
from catstream.video.source import open_source
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import MODELS
from catstream.wire.newest import Subscriber
from catstream.wire.timing import EARLY_SECONDS

__all__ = ["main", "opening_seconds", "prepare"]

Message = TypeVar("Message", Features | End, Tracks | End)

_FILE = "desired_state.json"  # in the folder of the state
_COMPRESSOR_SECONDS = 10.0  # time for the compressor to store the end, once the process was asked to end
_OWNER_SECONDS = 0.5  # the same for the owner of the run, which may no longer receive
_OPEN_SECONDS = 60.0  # limit for opening the source, and for the first frame
_SKIP_SECONDS = 0.1  # limit for decoding a skipped frame
_TURN_SECONDS = 0.02  # from one turn of a waiting loop to the next
_LONGEST_SOURCE = 1000  # characters of the source that are published with the health

_log = logging.getLogger(__name__)


def prepare() -> None:
    """Import everything that tracking needs, and limit OpenCV to the thread that calls it."""
    ridge.prepare()
    source.prepare()
    storage.prepare()
    cv2.setNumThreads(1)


def main(process: Process) -> None:
    """Track the objects of the job to the last frame of its source."""
    process.source = _shown(process.job.source)
    reason, failed = "the source has ended", False
    with ExitStack() as stack:
        loop = DetectorLoop(process, stack)
        loop.wait_for_subscribers()
        if process.job.resume:
            loop.resume()
        frames = loop.open(stack)
        try:
            for frame in frames:
                result = loop.track(frame)
                if result is not None:
                    loop.send(frame, *result)
                    loop.wait_for_model()
                if loop.end_reason:
                    break
            reason = loop.end_reason or reason
        except VideoError as error:
            reason, failed = str(error), True
        loop.end(reason, failed)
        process.source_failed = failed
        if failed:
            _log.error("%s", reason)


class DetectorLoop:
    """The detectors, and the sockets that they are connected to.

    Every method that waits does so in turns: see `turn`.
    """

    def __init__(self, process: Process, stack: ExitStack) -> None:
        state = process.job.state
        file = state / _FILE if state is not None else None
        objects.prepare(process.settings)
        self.detectors = Detectors(process.settings)
        self._process, self._model_files = process, ModelFiles(state / SEARCHED if state is not None else None)
        self._commands = CommandHandler(self.detectors, _desired(process, self._model_files), self._model_files)
        self._control = stack.enter_context(CommandChannel(process.endpoint, self._commands, file, process.allow))
        self._outputs = stack.enter_context(Outputs(process))
        self._models = stack.enter_context(Subscriber(MODELS, process.endpoint))
        self._source: Source | None = None
        self._skipped = 0  # frames that were skipped while the run was paused or waited for a box
        self._tracks = Tracks(0, 0, {})  # the last ones
        self._sent_before = math.inf if process.job.resume else 0  # the last message of an earlier detector

    @property
    def end_reason(self) -> str:
        """Reason for which no more frames are tracked; empty while frames are tracked."""
        return "it was stopped" if self._process.stop_requested else self._commands.end_reason

    @property
    def _repeats(self) -> bool:
        """Whether an earlier detector has sent the next message already: commands and pauses apply after those."""
        return self.detectors.seq < self._sent_before

    @property
    def _holds(self) -> bool:
        """Whether no frames are tracked, because the run is paused or waits for a box."""
        return self._commands.desired.holds and not self._repeats

    def turn(self, sender: DataSender | None = None) -> None:
        """One turn of a waiting loop: process acknowledgements and commands, and publish the health.

        If a sender is given, wait a short time for its acknowledgements.
        """
        self._outputs.poll(sender)
        self._serve()

    def _serve(self) -> None:
        """Serve late joiners, carry out the commands that have arrived, and publish the health."""
        self._outputs.serve_late_joiners()
        commanded = self._control.carry_out(repeats=self._repeats)
        self._process.beat(self._counters, self._object_counters, now=commanded)

    def wait_for_subscribers(self) -> None:
        """Wait for the recorder without a time-out, and for early subscribers for a few seconds."""
        deadline = time.monotonic() + EARLY_SECONDS
        while (missing := self._outputs.awaited) and (RECORDER in missing or time.monotonic() < deadline):
            self._outputs.poll(self._outputs.features)
            self._serve_or_exit()

    def resume(self) -> None:
        """Continue after the last message that all receivers have stored."""
        models: dict[str, Model] = {}
        commands = self._commands
        positions = [self._position(sender) for sender in self._outputs.senders]
        while not agree(positions, models, commands.desired):
            if (model := self._models.receive(_TURN_SECONDS)) is not None:
                models[model.object] = model
            positions = [self._position(sender) for sender in self._outputs.senders]
        begin = start(positions, models, commands.desired, Detector(self._process.settings).state_at)
        self.detectors.seq, commands.desired = begin.seq, begin.desired
        for name, (state, model) in begin.objects.items():
            self.detectors.add(name).resume(state, model)
        for name, each in begin.desired.objects_at(begin.seq).items():
            self._seek_again(name, each, models)
        for sender, position in zip(self._outputs.senders, positions, strict=True):
            sender.resume(begin.seq, position)
        self._sent_before = max(position.seq for position in positions)

    def _seek_again(self, name: str, each: DesiredObject, models: dict[str, Model]) -> None:
        """Continue to search for an object by its saved model, unless it was found before the restart."""
        known = self.detectors.detectors.get(name)
        if known is not None and (known.state is None or known.state.first_window is not None):
            return
        if (learned := self._learned(each)) is None:
            return
        if known is not None:
            known.likeness = learned.likeness()
        else:  # its state is not known: it counts as not found
            model = models.get(name, learned.model)
            self.detectors.add(name).seek(model, learned.box, learned.likeness(), each.begins - 1)

    def _learned(self, each: DesiredObject) -> Learned | None:
        """The saved model that an object begins with, None if it has none."""
        return self._model_files.get(each.model) if each.model else None

    def _position(self, sender: DataSender) -> Position:
        """The position that a receiver reports; there is no time-out."""
        while (position := sender.ask_position()) is None:  # without `poll`, which would consume the answer
            self._serve_or_exit()
        return position

    def _serve_or_exit(self) -> None:
        """One turn before the first frame: no message was sent yet, so the process may exit at once."""
        self._serve()
        if self._process.stop_requested:
            raise SystemExit(0)

    def open(self, stack: ExitStack) -> Iterator[Frame]:
        """Open the source at the frame before the next one, which always exists."""
        job, settings = self._process.job, self._process.settings
        first = max(self.detectors.seq - 1, 0)
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
                resize=settings.run.resize,
            )
        )
        return self._source if self._source.live else stack.enter_context(closing(read_ahead(self._source)))

    def _idle(self) -> bool:
        """One turn while a live source provides no frame; returns whether to stop waiting."""
        self.turn()
        if self._source is not None and self._source.counters.get("lost_seconds"):
            self._control.reject_boxes("the source is lost, so there is no frame for a box: try again once it is back")
        return bool(self.end_reason)

    def track(self, frame: Frame) -> tuple[Tracks, Features] | None:
        """The tracks and the features of a frame; None if it is skipped."""
        if frame.number < self.detectors.seq:
            return None
        self.turn()
        pyramid = Pyramid.of(frame.image)
        given = self._given(pyramid, frame) or self._hold(pyramid, frame)
        if not given and self.end_reason:
            return None
        if not given and self._holds:
            self._skipped += 1
            return None
        return self._step(pyramid, frame, given)

    def _hold(self, pyramid: Pyramid, frame: Frame) -> dict[str, Result]:
        """Keep a frame while the run is paused or has no box; frames of a live source are not kept.

        Returns
        -------
        the results of the objects whose boxes commands have set for it
        """
        if self._holds:
            kept = {name: each for name, each in self._tracks.tracks.items() if name in self._commands.desired.objects}
            self._outputs.show(self.detectors.seq, frame.image, kept)  # the other objects, while a box is drawn
        live = self._source is not None and self._source.live
        while self._holds and not self.end_reason and not live:
            time.sleep(_TURN_SECONDS)
            self.turn()
            if given := self._given(pyramid, frame):
                return given
        return {}

    def _given(self, pyramid: Pyramid, frame: Frame) -> dict[str, Result]:
        """The results of the objects whose boxes commands have set for a frame, by name."""
        if self._commands.has_box:
            self._process.allow(_OPEN_SECONDS)
        return self._control.begin(pyramid, frame.time)

    def _step(self, pyramid: Pyramid, frame: Frame, given: dict[str, Result]) -> tuple[Tracks, Features]:
        """The tracks and the features of a frame, which may be repeated after a restart."""
        detectors, seq = self.detectors, self.detectors.seq + 1
        for model in self._models.receive_all():
            detectors.adopt(model)
        objects = self._commands.desired.objects_at(seq)
        for name in detectors.detectors.keys() - objects.keys():
            detectors.forget(name)
        begun: dict[str, Learned] = {}
        for name, each in objects.items():  # in the order in which they began, in which the samples are numbered
            if name in given:
                continue
            if seq == each.begins:
                self._process.allow(_OPEN_SECONDS)
            if seq == each.begins and (learned := self._learned(each)) is not None:
                detectors.seek(name, learned.model, learned.box, learned.likeness())
                begun[name] = learned
            elif seq == each.begins and not each.model:
                given[name] = detectors.begin(name, pyramid, each.box, frame.time)
            elif name not in detectors.detectors:  # it was forgotten later: see `catstream.services.resume`
                given[name] = Detector(self._process.settings, name).miss(seq, frame.time)
        tracks, features = detectors.step(pyramid, frame.time, given)
        models = {name: replace(features.objects[name], model=learned.to_bytes()) for name, learned in begun.items()}
        return tracks, replace(features, objects=features.objects | models)

    def send(self, frame: Frame, tracks: Tracks, features: Features) -> None:
        """Send the tracks and the features of a frame; wait while a window is full."""
        tracks = replace(tracks, tracks={name: replace(each, pts=frame.pts) for name, each in tracks.tracks.items()})
        self._tracks = tracks
        self._outputs.publish_tracks(tracks)
        if (results := self._outputs.results) is not None:
            self._deliver(results, tracks)
            # In lockstep the owner is never behind: after a crash, all continue after the same message.
            while (
                self._process.settings.run.lockstep and results.taken < tracks.seq and not self._process.stop_requested
            ):
                self.turn(results)
        self._outputs.publish_features(features)
        self._deliver(self._outputs.features, features)
        self._outputs.show(tracks.frame, frame.image, tracks.tracks)

    def wait_for_model(self) -> None:
        """Wait until the models are recent enough: see `catstream.services.pacing`."""
        settings, features = self._process.settings, self._outputs.features
        due = features.sent - (0 if settings.run.lockstep else settings.run.lag_frames)
        live = self._source is not None and self._source.live
        while not live and not self.end_reason:
            match awaited(due, features.taken, features.count_samples(due), self.detectors.newest_versions(due)):
                case Awaited.NOTHING:
                    return
                case Awaited.TAKEN:
                    self.turn(features)
                case Awaited.MODEL:  # `turn` retransmits features to a restarted compressor
                    if (model := self._models.receive(_TURN_SECONDS)) is not None:
                        self.detectors.adopt(model)
                    self.turn()

    def end(self, reason: str, failed: bool) -> None:
        """Send the end of the stream, and wait until it is stored; with a time-out if the process was asked to end."""
        self._control.end(reason)
        features, results, seq = self._outputs.features, self._outputs.results, self.detectors.seq
        self._deliver(features, End(seq + 1, reason, failed), _COMPRESSOR_SECONDS, stored=True)
        totals = {"sent": float(seq), "stored": float(min(features.stored, seq))} | self._source_counters()
        totals.pop("lost_seconds", None)  # this one is of the moment
        end = End(seq + 1, reason, failed, totals)
        if results is not None:
            self._deliver(results, end, _OWNER_SECONDS, stored=True)
        self._control.clear_stop()
        self._outputs.publish_tracks(end)
        self._outputs.publish_features(end)
        self._process.beat(self._counters, self._object_counters, now=True)

    def _deliver(
        self, sender: Sender[Message], message: Message, patience: float = 0.0, *, stored: bool = False
    ) -> None:
        """Send a message on an acknowledged channel; wait for room in its window, or until it is `stored`."""
        sent = sender.send(message)
        while True:
            step = next_step(
                sent=sent,
                stored=not stored or sender.acknowledged >= message.seq,
                seconds_since_stop=self._process.seconds_since_stop,
                patience_seconds=patience,
            )
            match step:
                case Step.DONE:
                    return
                case Step.GIVE_UP:
                    if not sent:
                        lost = "message %d of %s was not sent: its receiver did not answer in time"
                        _log.warning(lost, message.seq, sender.channel.name)
                    return
                case Step.WAIT:
                    self.turn(sender)
                case Step.SEND:
                    self.turn(sender)
                    sent = sender.send(message)

    def _counters(self) -> dict[str, float]:
        """The counters for the health of the process."""
        features = self._outputs.features
        own = {
            "sent": features.sent,
            "taken": features.taken,
            "stored": features.stored,
            "model_version": max((each.model_version for each in self._tracks.tracks.values()), default=0),
            "objects": len(self._commands.desired.objects),
        }
        return own | self._commands.counters | self._source_counters()

    def _source_counters(self) -> dict[str, float]:
        """The counters of the source; frames that were skipped while the run was paused count, too."""
        counters = self._source.counters if self._source is not None else {}
        if "skipped" in counters:
            counters["skipped"] += self._skipped
        return counters

    def _object_counters(self) -> dict[str, dict[str, float]]:
        """The counters of each object, by name, for the health of the process."""
        return {
            name: {"model_version": each.model_version, "score": each.score, "present": float(each.box is not None)}
            for name, each in self._tracks.tracks.items()
            if name in self._commands.desired.objects
        }


def opening_seconds(part: slice, first: int) -> tuple[float, float]:
    """Time limits: for opening a source at frame `first` of a part, and the additional time for each frame."""
    step = part.step or 1
    return _OPEN_SECONDS + ((part.start or 0) + first * step) * _SKIP_SECONDS, (step - 1) * _SKIP_SECONDS


def _desired(process: Process, models: ModelFiles) -> DesiredState:
    """The desired state at the start: the stored one if the run is resumed, otherwise that of the job."""
    job = process.job
    if job.resume and job.state is not None and (job.state / _FILE).exists():
        try:
            return DesiredState.load(job.state / _FILE)
        except ProtocolError as error:  # the checkpoints are not affected, so the run continues
            process.trouble = str(error)
            _log.warning("%s", error)
    boxes = {name: DesiredObject(box, begins=1) for name, box in job.boxes.items()}
    learned = {name: Learned.load(file) for name, file in job.models.items()}
    sought = {name: DesiredObject(each.box, begins=1, model=models.add(each)) for name, each in learned.items()}
    return DesiredState(boxes | sought)


def _shown(source: str) -> str:
    """A source without secrets: an address without user, password and query, which may contain them too.

    >>> _shown("http://me:secret@10.0.0.7/video.mjpg?pwd=secret")
    'http://10.0.0.7/video.mjpg'
    """
    text = without_password(source)
    if "://" in text:
        text = text.partition("?")[0]
    return text.encode(errors="replace").decode()[:_LONGEST_SOURCE]  # the name of a file need not be UTF-8
