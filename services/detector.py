"""The process that tracks the objects in each frame with their newest models, and sends tracks and features.

`main` shows the order of events. `DetectorLoop` tells its core what happens, and carries out what the core orders: all
decisions are in `catstream.services.core`.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2

from catstream.detection.detector import Detector, Result
from catstream.detection.objects import Detectors
from catstream.errors import BoxError, CatstreamError, ObjectError, ProtocolError, VideoError
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import Command, End, Features, Model, Position, Tracks
from catstream.run.learned import Learned
from catstream.run.state import SEARCHED
from catstream.services import actions, core
from catstream.services.actions import Action
from catstream.services.core import Event, History
from catstream.services.core_state import Known, Phase, Progress, Request, Rules, State
from catstream.services.desired import DESIRED, DesiredObject, DesiredState
from catstream.services.loop import Process
from catstream.services.model_files import ModelFiles
from catstream.services.outputs import Outputs
from catstream.services.timing import CLOSE_SECONDS, MODEL_SECONDS, OPEN_SECONDS, SKIP_SECONDS, TURN_SECONDS
from catstream.video import source
from catstream.video.frames import Frame, Source, read_ahead, without_password
from catstream.video.source import is_live, open_source
from catstream.wire.channels import CONTROL, MODELS
from catstream.wire.commands import Responder
from catstream.wire.newest import Subscriber

_EVENTS_FILE = "detector_events.ndjson"  # in the folder of the state, after a crash
_LONGEST_SOURCE = 1000  # characters of the source that are published with the health

#: The channel whose acknowledgements are waited for in a phase.
_CHANNELS = {
    Phase.SUBSCRIBERS: "features",
    Phase.RESULTS: "results",
    Phase.OWNER: "results",
    Phase.FEATURES: "features",
    Phase.TAKEN: "features",
}

_GIVEN_UP = "message %d of %s was not sent: its receiver did not answer in time"
_log = logging.getLogger(__name__)


def prepare() -> None:
    """Import everything that tracking needs, and limit OpenCV to the thread that calls it."""
    source.prepare()
    cv2.setNumThreads(1)


def main(process: Process) -> None:
    """Track the objects of the job to the last frame of its source."""
    process.source = _shown(process.job.source)
    reason, failed = "the source has ended", False
    with ExitStack() as stack:
        loop = DetectorLoop(process, stack)
        stack.callback(process.watchdog.allow, CLOSE_SECONDS)
        loop.wait()  # for subscribers, and for the position of an earlier detector
        frames = loop.open(stack)
        try:
            for frame in frames:
                loop.take(frame)
                if loop.state.end_reason:
                    break
        except VideoError as error:
            reason, failed = str(error), True
        process.source_failed = failed
        loop.end(reason)
        if failed:
            _log.error("%s", reason)


class DetectorLoop:
    """The detectors, and the sockets that they are connected to."""

    def __init__(self, process: Process, stack: ExitStack) -> None:
        settings, job = process.settings, process.job
        self._process, self._began = process, time.monotonic()
        self._models_of_job = ModelFiles(job.state / SEARCHED if job.state is not None else None)
        desired = _desired(process, self._models_of_job)
        rules = Rules(
            window=settings.run.unstored_frames,
            lag_frames=0 if settings.run.lockstep else settings.run.lag_frames,
            lockstep=settings.run.lockstep,
            objects_most=settings.run.objects_most,
            context=settings.search.context,
            owned=job.owned,
            recorded=job.record is not None,
            resumes=job.resume,
        )
        self._core = History(State.at_start(rules, desired))
        stack.push(self._write_events)
        self._detectors = Detectors(settings)
        self._control: Responder[Command, Any] = stack.enter_context(
            Responder(CONTROL, process.endpoint, longest=CONTROL.limit)
        )
        self._outputs = stack.enter_context(Outputs(process))
        self._models = stack.enter_context(Subscriber(MODELS, process.endpoint))
        self._source: Source | None = None
        self._kept: DesiredState | None = None  # in the file
        self._frame: Frame  # the present one, and its pyramid
        self._pyramid: Pyramid
        self._given: dict[str, Result] = {}  # of the objects that are not searched in it
        self._begun: dict[str, Learned] = {}  # the saved models that begin in it
        self._tracks = Tracks(0, 0, {})  # the last ones
        self._features = Features(0, 0, 0.0, {})
        self._positions: dict[str, Position] = {}  # the answers of the receivers, by channel
        self._arrived: dict[str, Model] = {}  # of the objects that have no detector yet
        self._do: dict[type[Action], Callable[[Any], Event | None]] = {
            actions.Continue: self._continue,
            actions.Resume: self._resume,
            actions.SetBox: self._set_box,
            actions.Forget: lambda order: self._detectors.forget(order.name),
            actions.Begin: self._begin,
            actions.Seek: self._seek,
            actions.Miss: self._miss,
            actions.Step: self._step,
            actions.Send: self._send,
            actions.GiveUp: lambda order: _log.warning(_GIVEN_UP, order.seq, order.channel),
            actions.Show: self._show,
            actions.Conclude: self._conclude,
            actions.Finish: self._finish,
        }
        self._conclude(actions.Conclude((), tuple(desired.models_since(0))))
        self._tell_subscribed()

    @property
    def state(self) -> State:
        """The state of the core."""
        return self._core.state

    def tell(self, event: Event) -> None:
        """Tell the core what has happened, and carry out its actions; their results are further events."""
        events = deque([event])
        while events:
            for action in self._core.handle(events.popleft()):
                if (result := self._do[type(action)](action)) is not None:
                    events.append(result)

    def wait(self) -> None:
        """Wait in turns until the next frame can be taken, or the stream has ended."""
        while self.state.phase not in (Phase.FRAME, Phase.ENDED):
            self.turn()
        if self.state.phase is Phase.ENDED:  # a signal arrived before anything was sent
            raise SystemExit(0)

    def turn(self) -> None:
        """Wait a short time for what the core waits for; then serve everybody else, and publish the health."""
        phase = self.state.phase
        if phase is Phase.POSITIONS:
            self._ask_positions()
        else:
            self._outputs.poll(_CHANNELS.get(phase))
        if phase not in (Phase.SUBSCRIBERS, Phase.POSITIONS):  # before, they belong to no detector yet
            self._receive_models(TURN_SECONDS if phase is Phase.MODEL else 0.0)
        if phase is Phase.HELD:
            time.sleep(TURN_SECONDS)
        self._outputs.serve_late_joiners()
        commands = self._control.receive_all()
        for command in commands:
            self.tell(core.Commanded(self._request(command)))
        if self._process.stop_requested and (self.state.stopping < 0 or phase is not Phase.FRAME):
            self.tell(core.Stopping(self._process.seconds_since_stop))
        if self.state.phase is Phase.SUBSCRIBERS:
            self._tell_subscribed()
        if (progressed := self._progressed()) is not None:
            self.tell(progressed)
        self._process.beat(self._counters, self._object_counters, now=bool(commands))

    def open(self, stack: ExitStack) -> Iterator[Frame]:
        """Open the source at the next frame; a file at the one before, which always exists."""
        job, settings = self._process.job, self._process.settings
        first = self.state.seq if is_live(job.source) else max(self.state.seq - 1, 0)
        once, each = opening_seconds(job.part, first)
        self._process.watchdog.allow(once)
        self._process.watchdog.allow_each(each)
        self._source = stack.enter_context(
            open_source(
                job.source,
                first,
                part=job.part,
                since=job.since,
                idle=self._idle,
                settings=settings.run,
            )
        )
        if not self._source.live:
            return stack.enter_context(closing(read_ahead(self._source)))
        self._source.size = job.size or self._source.size  # a camera may have another one than when the run began
        return self._source

    def _idle(self) -> bool:
        """One turn while a live source provides no frame; returns whether to stop waiting."""
        self.turn()
        if self.state.boxes and self._source is not None and self._source.counters.get("lost_seconds"):
            self.tell(core.SourceLost())
        return bool(self.state.end_reason)

    def take(self, frame: Frame) -> None:
        """Track the objects in a frame, and wait until the next one can be taken."""
        self.turn()
        self._frame, self._pyramid = frame, Pyramid(frame.image)
        self.tell(core.Frame(frame.number, self._source is not None and self._source.live))
        self.wait()

    def end(self, reason: str) -> None:
        """Send the end of the stream, and wait until it is stored; with a time-out if the process was asked to end."""
        self.tell(core.Ended(reason, self._process.source_failed))
        while self.state.phase is not Phase.ENDED:
            self.turn()

    # What the core is told

    def _tell_subscribed(self) -> None:
        self.tell(core.Subscribed(True, True, time.monotonic() - self._began))

    def _request(self, command: Command) -> Request:
        """A command without the saved model, which is kept here."""
        if (data := command.model) is None:
            return Request(command)
        self._process.watchdog.allow(MODEL_SECONDS)
        command = replace(command, model=b"")
        try:
            learned = Learned.from_bytes(data, "the file")
            learned.check_fits(self._process.settings)
        except CatstreamError as error:
            return Request(command, error=str(error))
        return Request(command, self._models_of_job.add(learned))

    def _ask_positions(self) -> None:
        """Ask the receivers for their positions, and receive the models that belong to them."""
        senders = self._outputs.senders
        for name in senders.keys() - self._positions.keys():
            if (position := senders[name].ask_position()) is not None:
                self._positions[name] = position
        if self._positions.keys() < senders.keys():
            return
        self.tell(core.Positions(tuple(self._positions[name] for name in senders)))
        if self.state.phase is Phase.POSITIONS:  # they do not agree yet
            self._positions.clear()
            self._receive_models(TURN_SECONDS)

    def _receive_models(self, seconds: float) -> None:
        """Receive models, waiting at most this long for the first; the detectors adopt those of their objects."""
        for model in self._models.receive_all(seconds):
            if self.state.phase is Phase.POSITIONS:
                self._arrived[model.object] = model
                self.tell(core.ModelArrived(model.object, model.version))
            elif model.object in self.state.known:
                detector = self._detectors.detectors[model.object]
                detector.adopt(model)
                self.tell(core.ModelArrived(model.object, model.version, _known(detector)))
            elif self.state.is_repeating:  # the object may begin again: its trees are ahead of the tracks
                self._arrived[model.object] = model

    def _progressed(self) -> Event | None:
        """The progress of the receivers, if the core waits for it and it is another one than before."""
        if self.state.phase is Phase.FRAME or (progress := self._progress(self.state.due)) == self.state.progress:
            return None
        return core.Progressed(progress)

    def _progress(self, due: int) -> Progress:
        """How far the receivers are; the samples count up to message `due`."""
        outputs = self._outputs
        features, results = outputs.features.window, (outputs.results or outputs.features).window
        samples = features.count_samples(due)
        of_features = features.acknowledged, features.taken, features.limit
        of_results = results.acknowledged, results.taken, results.limit
        return Progress(*of_features, *of_results, due, samples)

    # What the core orders

    def _continue(self, order: actions.Continue) -> None:
        detector, state, box = self._detectors.add(order.name), order.at.detector, order.at.box
        if state is None and box is not None:
            state = detector.state_at(box, order.first, order.began)
        if state is not None:
            detector.resume(state, self._arrived[order.name])
        if order.model and (learned := self._models_of_job.get(order.model)) is not None:
            detector.likeness = learned.likeness()

    def _resume(self, order: actions.Resume) -> Event:
        self._detectors.seq = order.seq
        for sender, position in zip(self._outputs.senders.values(), order.positions, strict=True):
            sender.window.resume(order.seq, position)
        return core.Resumed(self._known())

    def _set_box(self, order: actions.SetBox) -> Event:
        self._process.watchdog.allow(OPEN_SECONDS)
        detectors, time_ = self._detectors, self._frame.time
        act = detectors.correct if order.keep else detectors.begin
        try:
            self._given[order.name] = act(order.name, self._pyramid, order.box, time_)
        except (BoxError, ObjectError) as error:
            return core.Begun(error=str(error))
        return core.Begun(_known(detectors.detectors[order.name]))

    def _begin(self, order: actions.Begin) -> None:
        self._process.watchdog.allow(OPEN_SECONDS)
        self._given[order.name] = self._detectors.begin(order.name, self._pyramid, order.box, self._frame.time)

    def _seek(self, order: actions.Seek) -> None:
        self._process.watchdog.allow(OPEN_SECONDS)
        learned, name = self._models_of_job.get(order.model), order.name
        if learned is None:  # its file cannot be read
            if name in self._detectors.detectors:
                self._detectors.forget(name)
            if not order.again:
                self._miss(actions.Miss(name))
        elif order.again:
            model = self._arrived.get(name, learned.model)
            self._detectors.add(name).seek(model, learned.box, learned.likeness(), order.began)
        else:
            self._detectors.seek(name, learned.model, learned.box, learned.likeness())
            self._begun[name] = learned

    def _miss(self, order: actions.Miss) -> None:
        absent = Detector(self._process.settings, order.name)
        self._given[order.name] = absent.miss(self.state.seq + 1, self._frame.time)

    def _step(self, _: actions.Step) -> Event:
        tracks, features = self._detectors.step(self._pyramid, self._frame.time, self._given)
        for name in self._arrived.keys() & tracks.tracks.keys():
            self._detectors.adopt(self._arrived.pop(name))
        models = {
            name: replace(features.objects[name], model=learned.to_bytes()) for name, learned in self._begun.items()
        }
        pts = self._frame.pts
        self._tracks = replace(tracks, tracks={name: replace(each, pts=pts) for name, each in tracks.tracks.items()})
        self._features = replace(features, objects=features.objects | models)
        self._given, self._begun = {}, {}
        self._outputs.publish(self._tracks, self._features)
        return core.Stepped(self._known(), self._progress(self.state.due + 1))

    def _send(self, order: actions.Send) -> Event | None:
        results, features = self._outputs.results, self._outputs.features
        if order.channel == "features":
            failed = self._process.source_failed
            features.send(End(order.seq, self.state.ending, failed) if order.end else self._features)
            return self._progressed()
        if results is not None:
            results.send(self._end if order.end else self._tracks)
        return None

    def _show(self, order: actions.Show) -> None:
        tracks = self._tracks.tracks
        wanted = self.state.desired.objects if order.held else tracks
        boxes = {name: each.box for name, each in tracks.items() if each.box is not None and name in wanted}
        number = self.state.seq if order.held else self._tracks.frame  # a live source counts the skipped frames too
        self._outputs.previews.show(number, self._frame.image, boxes)

    def _conclude(self, order: actions.Conclude) -> None:
        """Store the desired state if it has changed, then send the answers; those say so if it could not be stored."""
        state, desired, lost = self._process.job.state, self.state.desired, ""
        if state is not None and desired != self._kept:
            try:
                self._models_of_job.store()  # before the state that names them
                desired.save(state / DESIRED)
                self._kept = desired
            except OSError as error:
                _log.warning("the desired state cannot be written to %s (%s)", state / DESIRED, error.strerror)
                lost = f"; a resumed run will not know it, as {state / DESIRED} cannot be written ({error.strerror})"
        if state is None or desired == self._kept:  # otherwise the file may name a model that is not needed any more
            self._models_of_job.keep_only(set(order.models))
        for answer in order.answers:
            self._control.answer(replace(answer, reason=answer.reason + lost) if answer.done else answer)

    def _finish(self, _: actions.Finish) -> None:
        self._outputs.publish(self._end, self._end)
        self._process.beat(self._counters, self._object_counters, now=True)

    @cached_property
    def _end(self) -> End:
        """The end of the stream, with what a run must not forget."""
        stored, seq = self._outputs.features.window.stored, self.state.seq
        totals = {"sent": float(seq), "stored": float(min(stored, seq))} | self._source_counters()
        totals.pop("lost_seconds", None)  # this one is of the moment
        return End(seq + 1, self.state.ending, self._process.source_failed, totals)

    def _known(self) -> dict[str, Known]:
        """The detectors by name, as the core sees them."""
        return {name: _known(each) for name, each in self._detectors.detectors.items()}

    def _counters(self) -> dict[str, float]:
        """The counters for the health of the process."""
        features, desired = self._outputs.features.window, self.state.desired
        own = {
            "sent": features.sent,
            "taken": features.taken,
            "stored": features.stored,
            "model_version": max((each.model_version for each in self._tracks.tracks.values()), default=0),
            "objects": len(desired.objects),
            "paused": float(desired.paused),
            "waiting": float(not desired.objects),
        }
        return own | self._source_counters()

    def _source_counters(self) -> dict[str, float]:
        """The counters of the source; frames that were skipped while the run was paused count, too."""
        counters = self._source.counters if self._source is not None else {}
        if "skipped" in counters:
            counters["skipped"] += self.state.skipped
        return counters

    def _object_counters(self) -> dict[str, dict[str, float]]:
        """The counters of each object, by name, for the health of the process."""
        return {
            name: {"model_version": each.model_version, "score": each.score, "present": float(each.box is not None)}
            for name, each in self._tracks.tracks.items()
            if name in self.state.desired.objects
        }

    def _write_events(self, kind: type[BaseException] | None, *_: object) -> None:
        """After a crash, write the last events to the folder of the state: see `History.write`."""
        if kind is None or not issubclass(kind, Exception) or issubclass(kind, CatstreamError):
            return
        file = (self._process.job.state or Path(tempfile.gettempdir())) / _EVENTS_FILE
        try:
            self._core.write(file)
            _log.error("the last events before this error are in %s", file)
        except OSError as error:
            _log.warning("the last events cannot be written to %s (%s)", file, error.strerror)


def _known(detector: Detector) -> Known:
    """A detector as the core sees it."""
    if (state := detector.state) is None:
        raise ValueError(f"the detector of {detector.name!r} has no object yet")
    return Known(detector.model.version, detector.newest_version, state.first_frame, state.is_sought, state.window)


def opening_seconds(part: slice, first: int) -> tuple[float, float]:
    """Time limits: for opening a source at frame `first` of a part, and the additional time for each frame."""
    step = part.step or 1
    return OPEN_SECONDS + ((part.start or 0) + first * step) * SKIP_SECONDS, (step - 1) * SKIP_SECONDS


def _desired(process: Process, models: ModelFiles) -> DesiredState:
    """The desired state at the start: the stored one if the run is resumed, otherwise that of the job."""
    job = process.job
    if job.resume and job.state is not None and (job.state / DESIRED).exists():
        try:
            desired = DesiredState.load(job.state / DESIRED)
            return replace(desired, paused=desired.paused or job.paused)
        except ProtocolError as error:  # the checkpoints are not affected, so the run continues
            process.trouble = str(error)
            _log.warning("%s", error)
    boxes = {name: DesiredObject(box, begins=1) for name, box in job.boxes.items()}
    saved = {name: models.add(Learned.load(file)) for name, file in job.models.items()}
    sought = {name: DesiredObject(each.box, 1, each.name, each.size) for name, each in saved.items()}
    return DesiredState(boxes | sought, paused=job.paused)


def _shown(source: str) -> str:
    """A source without secrets: an address without user, password and query, which may contain them too.

    >>> _shown("http://me:secret@10.0.0.7/video.mjpg?pwd=secret")
    'http://10.0.0.7/video.mjpg'
    """
    text = without_password(source)
    if "://" in text:
        text = text.partition("?")[0]
    return text.encode(errors="replace").decode()[:_LONGEST_SOURCE]  # the name of a file need not be UTF-8
