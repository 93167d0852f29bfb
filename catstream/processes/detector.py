"""The process that tracks the objects in each frame with their newest models, and sends tracks and features.

`main` is what happens to a frame. `DetectorLoop` does it; the decisions are pure functions in
`catstream.processes.decisions` and `catstream.processes.control_commands`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from time import monotonic, sleep

import cv2

from catstream.base.addresses import without_password
from catstream.detection.detector import Result
from catstream.detection.objects import Detectors
from catstream.errors import BoxError, CatstreamError, ObjectError, ProtocolError, VideoError
from catstream.jobs.saved_model import SavedModel
from catstream.jobs.state import SEARCHED
from catstream.messages.kinds import Answer, Command, End, Features, Model, Track, Tracks, run_state
from catstream.processes.control_commands import STOPPED, answer, carried_out, check_room, is_kept, object_of
from catstream.processes.decisions import (
    DESIRED,
    NO_OWNER,
    DesiredObject,
    DesiredState,
    awaited,
    have_arrived,
    resume_at,
)
from catstream.processes.outputs import ModelFiles, Outputs
from catstream.processes.process import LONG_SECONDS, TURN_SECONDS, Process
from catstream.video import source as video_source
from catstream.video.frames import Frame, Source, read_ahead
from catstream.video.source import is_live, open_source
from catstream.wire.channels import CONTROL, MODELS
from catstream.wire.commands import Responder
from catstream.wire.newest import Subscriber

_LOOK_SECONDS = 0.002  # from one look at what the owner of the run has read to the next
_SKIP_SECONDS = 0.1  # limit for decoding a skipped frame
_FEATURES_END_SECONDS = 10.0  # limit for the end to be stored, once the process was asked to end
_RESULTS_END_SECONDS = 0.5  # the same for the owner of the run to receive the end
_LONGEST_SOURCE = 1000  # characters of the source that are published with the health

video_source.prepare()  # imports PyAV: once in the start server, not in each process
_log = logging.getLogger(__name__)


def main(process: Process) -> None:
    """Track the objects of the job to the last frame of its source."""
    reason, failed = "the source has ended", False
    with ExitStack() as stack:
        loop = DetectorLoop(process, stack)
        if process.job.resume and not loop.resume():
            return  # a signal came first
        try:
            for frame in loop.open(stack):
                loop.turn()  # carries out commands, serves late joiners, publishes the health
                given = loop.boxes_for(frame)  # of commands; a file waits here while the run is paused
                if not loop.leaves_out(given):
                    tracks, features = loop.track(frame, given)
                    loop.send(tracks, features)  # waits for room
                    loop.wait_for_models()  # at most `lag_frames` behind
                if loop.end_reason:
                    break
            reason = loop.end_reason or reason
        except VideoError as error:
            reason, failed = str(error), True
            _log.error("%s", reason)
        loop.end(reason, failed)


class DetectorLoop:
    """The detectors, and the sockets that they are connected to.

    Every method that waits does so in turns: see `turn`.
    """

    def __init__(self, process: Process, stack: ExitStack) -> None:
        cv2.setNumThreads(1)
        stack.callback(process.watchdog.allow)
        # The name of a file need not be UTF-8.
        process.source = without_password(process.job.source).encode(errors="replace").decode()[:_LONGEST_SOURCE]
        job, endpoint = process.job, process.endpoint
        self._process, self._live = process, is_live(job.source)
        self._model_files = ModelFiles(process.state / SEARCHED)
        self.desired = _desired(process, self._model_files)
        self.detectors = Detectors(process.settings, job.network)
        self._control: Responder[Command, Answer] = stack.enter_context(
            Responder(CONTROL, endpoint, longest=CONTROL.limit)
        )
        self._outputs = stack.enter_context(Outputs(process))
        self._models = stack.enter_context(Subscriber(MODELS, endpoint))
        self._source: Source | None = None
        self._repeats = 0  # the last message of an earlier detector: commands and pauses apply after it
        self._ending = STOPPED if self.desired.stopped else ""  # reason for which no more frames are tracked
        self._boxes: list[Command] = []  # that wait for a frame
        self._arrived: dict[str, Model] = {}  # of objects that have not begun again yet
        self._begun: dict[str, SavedModel] = {}  # the saved models that objects begin with in the next message
        self._skipped = 0  # frames that were left out because the run was paused or waited for a box
        self._paused_until = 0.0  # end of a pause that ends by itself, as its sender may be gone
        self._tracks = Tracks(0, 0, {})  # the last ones
        self._lost = False  # whether a message was given up, so that none may follow it
        self._kept: DesiredState | None = None  # in the file
        self._conclude()

    @property
    def end_reason(self) -> str:
        """Reason for which no more frames are tracked; empty while frames are tracked.

        The frames of an earlier detector are repeated before a command ends the stream: its end follows the last
        message that any receiver has.
        """
        if self._process.stop_requested:
            return "it was stopped"
        return "" if self._is_repeating else self._ending

    @property
    def _is_repeating(self) -> bool:
        """Whether an earlier detector has sent the next message already."""
        return self.detectors.seq < self._repeats

    @property
    def _holds(self) -> bool:
        """Whether no frames are tracked, because the run is paused or waits for a box."""
        return (self.desired.holds or self._is_paused) and not self._is_repeating

    @property
    def _is_paused(self) -> bool:
        return self.desired.paused or monotonic() < self._paused_until

    def turn(self) -> None:
        """Process acknowledgements, models and commands, serve late joiners, and publish the health."""
        self._outputs.features.poll(0)
        self._receive_models(0)
        self._serve()

    def _serve(self) -> None:
        self._outputs.serve_late_joiners()
        commanded = not self._is_repeating and self._carry_out()
        self._process.beat(self._counters, self._object_counters, now=commanded)

    def _receive_models(self, seconds: float) -> None:
        for model in self._models.receive_all(seconds):
            if model.object in self.detectors.detectors:
                self.detectors.adopt(model)
            elif self._is_repeating:  # the object begins again in one of these frames
                self._arrived[model.object] = model

    # Before the first frame

    def resume(self) -> bool:
        """Continue after the last frame that compressor and owner have; returns whether no signal came first."""
        process, features = self._process, self._outputs.features
        after = process.watchdog.after if process.job.run else NO_OWNER
        models: dict[str, Model] = {}
        self._repeats = NO_OWNER  # commands wait
        while True:
            position = features.ask_position(after)
            models |= {model.object: model for model in self._models.receive_all(TURN_SECONDS)}
            versions = {name: model.version for name, model in models.items()}
            if position is not None and have_arrived(position, self.desired, versions):
                break
            self._serve()
            if process.stop_requested:
                return False
        start = resume_at(position, after, self.desired, process.settings.search.context, live=self._live)
        self.detectors.seq, self._repeats, self.desired = start.seq, start.repeats, start.desired
        for name, state in start.states.items():
            detector = self.detectors.add(name)
            detector.resume(state, models[name])
            if state.is_sought and (learned := self._model_files.get(self.desired.objects[name].model)) is not None:
                detector.similarity = learned.similarity()
        self._arrived = {name: model for name, model in models.items() if name not in start.states}
        features.window.resume(start.seq, position)
        self._conclude()
        return True

    def open(self, stack: ExitStack) -> Iterator[Frame]:
        """The frames of the source from the next one on. A file is opened at the one before, which always exists."""
        job, settings, watchdog = self._process.job, self._process.settings, self._process.watchdog
        step = job.part.step or 1
        first = self.detectors.seq if self._live else max(self.detectors.seq - 1, 0)
        watchdog.allow(LONG_SECONDS + ((job.part.start or 0) + first * step) * _SKIP_SECONDS)
        watchdog.limit += (step - 1) * _SKIP_SECONDS
        part, since = job.part, job.since
        source = open_source(job.source, first, part=part, since=since, idle=self._idle, settings=settings.run)
        self._source = stack.enter_context(source)
        if self._live:
            self._source.size = job.size or self._source.size  # a camera may have another one than when the run began
        frames = self._source if self._live else stack.enter_context(closing(read_ahead(self._source)))
        return (frame for frame in frames if frame.number >= self.detectors.seq)

    def _idle(self) -> bool:
        """One turn while a live source provides no frame; returns whether to stop waiting."""
        self.turn()
        if self._boxes and self._source_counters().get("lost_seconds"):
            self._reject_boxes("the source is lost, so there is no frame for a box: try again once it is back")
        return bool(self.end_reason)

    # A frame

    def boxes_for(self, frame: Frame) -> dict[str, Result]:
        """The results of the objects whose boxes commands have set in a frame, by name.

        While the run is paused or has no object, a frame of a file waits here for a box, or for the end of the pause.
        """
        given = self._begin_boxes(frame)
        if self._holds and not given:
            # The other objects, while a box is drawn. A live source goes on: where they are by now is not known.
            self._show(self.detectors.seq, frame, {} if self._live else self._tracks.tracks)
        while self._holds and not (given or self.end_reason or self._live):
            sleep(TURN_SECONDS)
            self.turn()
            given = self._begin_boxes(frame)
        return given

    def leaves_out(self, given: Mapping[str, Result]) -> bool:
        """Whether a frame is not tracked: the stream ends, or a live source is paused."""
        if given or not (self.end_reason or self._holds):
            return False
        self._skipped += not self.end_reason
        return True

    def track(self, frame: Frame, given: dict[str, Result]) -> tuple[Tracks, Features]:
        """Find all objects in a frame; those begin whose first frame it is."""
        pyramid, seq = self.detectors.pyramid(frame.image), self.detectors.seq + 1
        for name, each in [*self.desired.objects.items()]:  # in their order the samples are numbered
            if name in given or (name in self.detectors.detectors and each.begins != seq):
                continue
            self._process.watchdog.allow()
            if not each.model:
                given[name] = self.detectors.begin(name, pyramid, each.box, frame.time)
            elif (learned := self._model_files.get(each.model)) is not None:
                self.detectors.seek(name, learned.model, learned.box, learned.similarity())
                self._begun[name] = learned
            else:
                self.desired = self.desired.without(name)
                self._conclude()
        tracks, features = self.detectors.step(pyramid, frame.time, given)
        for name in self._arrived.keys() & tracks.tracks.keys():
            self.detectors.adopt(self._arrived.pop(name))
        number = self._process.job.source_frame(frame.number)
        numbered = {name: replace(track, pts=frame.pts, source_frame=number) for name, track in tracks.tracks.items()}
        tracks = replace(tracks, tracks=numbered)
        models = {name: replace(features.objects[name], model=each.to_bytes()) for name, each in self._begun.items()}
        self._tracks, self._begun = tracks, {}
        self._show(tracks.frame, frame, tracks.tracks)
        return tracks, replace(features, objects=features.objects | models)

    def send(self, tracks: Tracks, features: Features) -> None:
        """Send the tracks to the owner and the features to the compressor once there is room; both to subscribers."""
        self._outputs.publish(tracks, features)
        process, results = self._process, self._outputs.results
        if results is not None:
            while (
                tracks.seq - process.watchdog.read > process.settings.run.unstored_frames and not process.stop_requested
            ):
                sleep(_LOOK_SECONDS)
                self.turn()
            while not results.send(tracks, TURN_SECONDS) and not process.stop_requested:
                self.turn()
        self._send_features(features)

    def _send_features(self, features: Features | End) -> None:
        """Send features once there is room; without it they are given up if the process is to end."""
        sender = self._outputs.features
        while sender.window.full and not self._process.stop_requested:
            sender.poll(TURN_SECONDS)
            self.turn()
        self._lost |= sender.window.full
        if not self._lost:
            sender.send(features)

    def wait_for_models(self) -> None:
        """Wait until the models are recent enough: see `awaited`. A live source does not wait."""
        run, features = self._process.settings.run, self._outputs.features
        due = self.detectors.seq - (0 if run.lockstep else run.lag_frames)
        while not (self.end_reason or self._live):
            known = self.detectors.detectors.items()
            newest = {name: each.newest_version for name, each in known if each.state and each.state.first_frame < due}
            channel = awaited(due, features.window.processed, features.window.count_samples(due), newest)
            if not channel:
                return
            if channel == "features":
                features.poll(TURN_SECONDS)
            else:
                self._receive_models(TURN_SECONDS)
            self.turn()

    def _show(self, number: int, frame: Frame, tracks: Mapping[str, Track]) -> None:
        """Show a frame with the boxes of the objects that are tracked, if somebody looks."""
        present = ((name, each.box) for name, each in tracks.items() if name in self.desired.objects)
        boxes = {name: box for name, box in present if box is not None}
        self._outputs.previews.show(number, frame, boxes)

    # Commands

    def _carry_out(self) -> bool:
        """Carry out the commands that have arrived; returns whether there were any. Boxes wait for a frame."""
        commands = self._control.receive_all()
        for command in commands:
            if self._ending and command.verb != "save":
                self._conclude(self._rejected(command, f"the pipeline is ending: {self._ending}"))
            elif command.verb == "set-box":
                self._boxes.append(command)
            else:
                self._conclude(self._carried_out(command))
                if self._ending:
                    self._reject_boxes(f"the pipeline is ending: {self._ending}")
        return bool(commands)

    def _carried_out(self, command: Command) -> Answer:
        try:
            self.desired, answered = carried_out(command, self.desired, self.detectors, self._saved_model(command))
        except CatstreamError as error:
            return self._rejected(command, str(error))
        for name in self.detectors.detectors.keys() - self.desired.objects.keys():
            self.detectors.forget(name)
        if command.verb == "resume" or (command.verb == "pause" and command.seconds is not None):
            self._paused_until = monotonic() + (command.seconds or 0.0)
        self._ending = STOPPED if self.desired.stopped else self._ending
        return answered

    def _saved_model(self, command: Command) -> DesiredObject | None:
        """The object that the saved model in a command begins."""
        if command.model is None:
            return None
        self._process.watchdog.allow()
        learned = SavedModel.from_bytes(command.model, "the file")
        learned.check_fits(self._process.settings, self.detectors.network)
        return self._model_files.add(learned)

    def _begin_boxes(self, frame: Frame) -> dict[str, Result]:
        """Begin the objects of the boxes that wait; of two boxes for one name, the second waits for the next frame."""
        given: dict[str, Result] = {}
        waiting, self._boxes = self._boxes, []
        for command in waiting:
            try:
                if (name := object_of(command, self.desired)) in given:
                    self._boxes.append(command)
                else:
                    self._conclude(self._box_begins(name, command, frame, given))
            except (BoxError, ObjectError) as error:
                self._conclude(self._rejected(command, str(error)))
        return given

    def _box_begins(self, name: str, command: Command, frame: Frame, given: dict[str, Result]) -> Answer:
        """Begin an object at the box of a command, or continue it there; its result is added to those given."""
        if command.box is None:
            raise BoxError("no box was given")
        detectors, box, at = self.detectors, command.box, f"at {command.box} in frame {self.detectors.seq}"
        frames = [frame]
        if command.time is not None and (kept := self._outputs.previews.since(command.time)):
            frames = [*kept, frame]
            at = f"at {box} in the picture {frame.time - command.time:.1f} s before frame {detectors.seq}"
        elif command.time is not None:
            at += ", as the picture in which it was drawn is not kept any more"
        later = (detectors.pyramid(each.image) for each in frames)
        first = next(later)
        check_room(name, self.desired, self._process.settings.run.objects_most)
        self._process.watchdog.allow()
        of_name = f" {name}" if name else ""
        if is_kept(command, name, self.desired, detectors):
            given[name] = detectors.correct(name, first, box, frame.time, later)
            effect = f"the same object{of_name} continues {at}"
        else:
            given[name] = detectors.begin(name, first, box, frame.time, later)
            box = (detectors.detectors[name].box or box) if len(frames) > 1 else box
            effect = f"{'another' if name in self.desired.objects else 'the'} object{of_name} begins {at}"
            self.desired = self.desired.begun(name, DesiredObject(box, detectors.seq + 1))
        return answer(command, detectors, True, effect, name, detectors.seq)

    def _rejected(self, command: Command, reason: str) -> Answer:
        return answer(command, self.detectors, False, reason)

    def _reject_boxes(self, reason: str) -> None:
        """Reject the boxes that wait for a frame, because there is none."""
        self._conclude(*(self._rejected(command, reason) for command in self._boxes))
        self._boxes.clear()

    def _conclude(self, *answers: Answer) -> None:
        """Store the desired state if it has changed, then send the answers; those say so if it could not be stored."""
        file, desired, lost = self._process.state / DESIRED, self.desired, ""
        if desired != self._kept:
            try:
                self._model_files.store()  # before the state that names them
                desired.save(file)
                self._kept = desired
            except OSError as error:
                _log.warning("the desired state cannot be written to %s (%s)", file, error.strerror)
                lost = f"; a resumed run will not know it, as {file} cannot be written ({error.strerror})"
        if desired == self._kept:  # otherwise the file may name a model that is not needed any more
            self._model_files.keep_only({each.model for each in desired.objects.values()})
        for each in answers:
            self._control.answer(replace(each, reason=each.reason + lost) if each.done else each)

    # The end

    def end(self, reason: str, failed: bool) -> None:
        """Send the end of the stream: to the compressor, and once that has stored everything, to the others.

        There is no time limit, unless the process was asked to end.
        """
        self._ending, self._repeats, self._process.source_failed = reason, 0, failed
        self._reject_boxes(f"the pipeline is ending: {reason}")
        process, features, results = self._process, self._outputs.features, self._outputs.results
        seq = self.detectors.seq
        self._send_features(End(seq + 1, reason, failed))
        while not self._lost and features.window.acknowledged <= seq:
            features.poll(TURN_SECONDS)
            self._serve()
            if process.seconds_since_stop > _FEATURES_END_SECONDS:
                break
        totals = {"sent": float(seq), "stored": float(min(features.window.stored, seq))} | self._source_counters()
        totals.pop("lost_seconds", None)  # this one is of the moment
        end = End(seq + 1, reason, failed, totals)
        sent = False
        while results is not None and process.watchdog.read < math.inf:
            sent = sent or results.send(end, TURN_SECONDS)
            sleep(_LOOK_SECONDS)
            self._serve()
            if process.seconds_since_stop > _RESULTS_END_SECONDS:
                break
        self.desired = replace(self.desired, stopped=False)  # a resumed detector does not stop at once
        self._conclude()
        self._outputs.publish(end, end)
        self._process.has_ended = True
        self._process.beat(self._counters, self._object_counters, now=True)

    # The health

    def _counters(self) -> dict[str, float]:
        window = self._outputs.features.window
        own = {
            "sent": window.sent,
            "processed": window.processed,
            "stored": window.stored,
            "model_version": max((each.model_version for each in self._tracks.tracks.values()), default=0),
            "objects": len(self.desired.objects),
            "time": max((each.time for each in self._tracks.tracks.values()), default=0.0),
            "paused": float(self._is_paused),
            "waiting": float(not self.desired.objects),
            "ended": float(self._process.has_ended),
        }
        return own | self._source_counters()

    def _source_counters(self) -> dict[str, float]:
        """The counters of the source; frames that were skipped while the run was paused count, too."""
        counters = self._source.counters if self._source is not None else {}
        if "skipped" in counters:
            counters["skipped"] += self._skipped
        return counters

    def _object_counters(self) -> dict[str, dict[str, float]]:
        """The counters of each object. While no frames are tracked, nothing is known of where it is."""
        known = {name: each for name, each in self._tracks.tracks.items() if name in self.desired.objects}
        found = {name: {"model_version": float(each.model_version)} for name, each in known.items()}
        if run_state(self._counters())[0] == "running":
            for name, each in known.items():
                found[name] |= {"score": each.score, "present": float(each.box is not None)}
        return found


def _desired(process: Process, models: ModelFiles) -> DesiredState:
    """The desired state at the start: the stored one if the run is resumed, otherwise that of the job."""
    job, file = process.job, process.state / DESIRED
    if job.resume and file.exists():
        try:
            desired = DesiredState.load(file)
            return replace(desired, paused=desired.paused or job.paused)
        except ProtocolError as error:  # the checkpoints are not affected, so the run continues
            process.trouble = str(error)
            _log.warning("%s", error)
    boxes = {name: DesiredObject(box, begins=1) for name, box in job.boxes.items()}
    saved = {name: models.add(SavedModel.load(file)) for name, file in job.models.items()}
    return DesiredState(boxes | saved, paused=job.paused)
