"""The process that tracks the objects in each frame with their newest models, and sends tracks and features.

`main` lists the steps for one frame; `DetectorLoop` implements them. Commands, new objects and outputs have modules of
their own; the decisions are pure functions in `catstream.processes.decisions` and
`catstream.processes.control_commands`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import cached_property
from time import monotonic, sleep, time

import cv2

from catstream.base import ridge
from catstream.base.addresses import is_live, without_password
from catstream.detection.objects import Detectors
from catstream.errors import VideoError
from catstream.features.pyramid import Pyramid
from catstream.processes.beginnings import Beginning, Beginnings
from catstream.processes.commands import Commands
from catstream.processes.decisions import TrainingLag, have_arrived, resume_at
from catstream.processes.outputs import Outputs
from catstream.processes.process import TURN_SECONDS, Process
from catstream.processes.shared import LONG_SECONDS
from catstream.video import source as video_source
from catstream.video.frames import Frame, Source, read_ahead
from catstream.video.source import open_source
from catstream.wire.channels import MODELS
from catstream.wire.messages import Features, Model, Track, Tracks, run_state
from catstream.wire.newest import Subscriber

_SKIP_SECONDS = 0.1  # limit for decoding a skipped frame
_LONGEST_SOURCE = 1000  # characters of the source that are published with the health

for module in (video_source, ridge):
    module.prepare()  # imports a library: once in the start server, not in each process
_log = logging.getLogger(__name__)


def main(process: Process) -> None:
    """Track the objects of the job to the last frame of its source."""
    with ExitStack() as stack:
        loop = DetectorLoop(process, stack)
        if process.job.resume and not loop.resume():
            return  # a signal came first
        try:
            for frame in loop.frames(stack):
                loop.turn()  # executes commands, serves late joiners, publishes the health
                beginnings = loop.begin(frame)  # of objects; while paused, a file source blocks here
                if not loop.skips(beginnings):
                    tracks, features = loop.track(frame, beginnings)
                    loop.outputs.send(tracks, features)  # waits for room
                    loop.wait_for_models()  # at most `lag_frames` behind
                if process.ending.reason:
                    break
            process.ending.begin("the source has ended")
        except VideoError as error:
            process.ending.begin(str(error), failed=True)
            _log.error("%s", error)
        loop.end()


class DetectorLoop:
    """The detectors of a stream, connected to its source, its commands, its models and its outputs.

    Every method that waits does so in turns: see `turn`.
    """

    def __init__(self, process: Process, stack: ExitStack) -> None:
        cv2.setNumThreads(1)
        stack.callback(process.watchdog.allow)
        # The name of a file need not be UTF-8.
        process.source = without_password(process.job.source).encode(errors="replace").decode()[:_LONGEST_SOURCE]
        self.process = process
        self.detectors = Detectors(process.settings)
        self.lag = TrainingLag()
        self.commands = stack.enter_context(Commands(process, self.detectors))
        self.outputs = stack.enter_context(Outputs(process, self.turn, self.lag.reply))
        self.models = Models(self.detectors, stack.enter_context(Subscriber(MODELS, process.endpoint)))
        self.beginnings = Beginnings(process, self.detectors, self.commands, self.outputs.previews)
        self._source: Source | None = None
        self._is_lost = False  # whether a live source was lost in the last turn
        self._skipped = 0  # frames that were skipped because the run was paused or waited for a box
        self._tracks = Tracks(0, {})  # the last ones

    def turn(self) -> None:
        """Process acknowledgements, models and commands, serve late joiners, and publish the health."""
        self.outputs.features.poll(0)
        self._receive_models(0)
        self._serve()

    def _serve(self) -> None:
        self.outputs.serve_late_joiners()
        changes = self.commands.execute()
        was_lost, self._is_lost = self._is_lost, bool(self._source_counters().get("lost_seconds"))
        self.process.beat(self._counters, self._object_counters, now=changes or self._is_lost != was_lost)

    def _receive_models(self, seconds: float) -> None:
        self.models.receive(seconds, keep=not self.commands.apply)

    @cached_property
    def _live(self) -> bool:
        return is_live(self.process.job.source)

    # Before the first frame

    def resume(self) -> bool:
        """Continue after the last frame that compressor and owner have; returns whether no signal came first."""
        process, commands, features = self.process, self.commands, self.outputs.features
        after = process.owner.after if process.owner is not None else None
        models: dict[str, Model] = {}
        while True:
            position = features.ask_position(after)
            models |= {model.object: model for model in self.models.receive_all(TURN_SECONDS)}
            versions = {name: model.version for name, model in models.items()}
            if position is not None and have_arrived(position, commands.desired, versions):
                break
            self._serve()
            if process.ending.reason:
                return False
        start = resume_at(position, after, commands.desired, live=self._live)
        self.detectors.seq = self.lag.processed = start.seq
        self.beginnings.resume(start, models)
        self.models.early = {name: model for name, model in models.items() if name not in start.states}
        features.window.resume(start.seq, position)
        commands.resume(start)
        return True

    def frames(self, stack: ExitStack) -> Iterator[Frame]:
        """The frames of the source from the next one on. A file is opened at the one before, which always exists."""
        job, settings, watchdog = self.process.job, self.process.settings, self.process.watchdog
        step = job.part.step or 1
        first = self.detectors.seq if self._live else max(self.detectors.seq - 1, 0)
        watchdog.allow(LONG_SECONDS + ((job.part.start or 0) + first * step) * _SKIP_SECONDS)
        watchdog.limit += (step - 1) * _SKIP_SECONDS
        source = open_source(
            *(job.source, first), part=job.part, since=job.since, rate=job.rate, idle=self._idle, settings=settings.run
        )
        self._source = stack.enter_context(source)
        if self._live:
            self._source.size = job.size or self._source.size  # a camera may have another one than when the run began
        frames = self._source if self._live else stack.enter_context(closing(read_ahead(self._source)))
        return (frame for frame in frames if frame.number >= self.detectors.seq)

    def _idle(self) -> bool:
        """One turn while a live source provides no frame; returns whether to stop waiting."""
        self.turn()
        if self._is_lost:
            self.commands.reject_boxes("the source is lost, so there is no frame for a box: try again once it is back")
        return bool(self.process.ending.reason)

    # A frame

    @property
    def _held(self) -> bool:
        """True if no frames are tracked: the stream ends, or the run is paused or waits for a box."""
        return bool(self.process.ending.reason) or self.commands.hold

    def begin(self, frame: Frame) -> list[Beginning]:
        """Begin the objects of a frame.

        While the run is paused or has no object, a frame of a file is held here until there is a box, or it resumes.
        """
        beginnings = self.beginnings.in_frame(frame, held=self._held)
        if self.commands.hold and not beginnings:
            # Show the other objects while a box is drawn. In a live source, their positions are out of date.
            self._show(self.detectors.seq, frame, {} if self._live else self._tracks.tracks)
        while self.commands.hold and not (beginnings or self.process.ending.reason or self._live):
            sleep(TURN_SECONDS)
            self.turn()
            beginnings = self.beginnings.in_frame(frame, held=self._held)
        return beginnings

    def skips(self, beginnings: Sequence[Beginning]) -> bool:
        """Return True if a frame is not tracked: the stream ends, or a live source is paused."""
        skips = self._held and not beginnings
        self._skipped += skips and not self.process.ending.reason
        return skips

    def track(self, frame: Frame, beginnings: Iterable[Beginning]) -> tuple[Tracks, Features]:
        """Find all objects in a frame; `beginnings` are those whose first frame it is."""
        results = {beginning.name: beginning.result for beginning in beginnings if beginning.result is not None}
        saved = {beginning.name: beginning.model for beginning in beginnings if beginning.model is not None}
        tracks, features = self.detectors.step(Pyramid(frame.image), frame.time, results)
        self.models.adopt_early(tracks.tracks)
        number = self.process.job.source_frame(tracks.frame)
        numbered = {name: replace(track, pts=frame.pts, source_frame=number) for name, track in tracks.tracks.items()}
        tracks = replace(tracks, tracks=numbered)
        parts = {name: replace(features.objects[name], model=model.to_bytes()) for name, model in saved.items()}
        self._tracks = tracks
        self._show(tracks.frame, frame, tracks.tracks)
        return tracks, replace(features, objects=features.objects | parts)

    def wait_for_models(self) -> None:
        """Wait until the models are recent enough: see `TrainingLag.awaited`. A live source does not wait."""
        run = self.process.settings.run
        due = self.detectors.seq - (0 if run.lockstep else run.lag_frames)
        while not (self.process.ending.reason or self._live):
            detectors = self.detectors.detectors.items()
            newest = {
                name: detector.newest_version
                for name, detector in detectors
                if detector.state and detector.state.first_frame < due
            }
            channel = self.lag.awaited(due, newest)
            if not channel:
                return
            if channel == "features":
                self.outputs.features.poll(TURN_SECONDS)
            else:
                self._receive_models(TURN_SECONDS)
            self.turn()

    def _show(self, number: int, frame: Frame, tracks: Mapping[str, Track]) -> None:
        """Show a frame with the boxes of the objects that are tracked, if there is a subscriber."""
        boxes = {name: track.box for name, track in tracks.items() if name in self.commands.desired.objects}
        present = {name: box for name, box in boxes.items() if box is not None}
        self.outputs.previews.show(number, frame, present)

    # The end

    def end(self) -> None:
        """Send the end of the stream: to the compressor, and once that has stored everything, to the others."""
        self.commands.begin_end()
        end = self.outputs.end(self.detectors.seq, self._source_counters)
        self.commands.allow_resume()
        self.outputs.publish(end, end)
        self.process.ending.receive(end)
        self.process.beat(self._counters, self._object_counters, now=True)

    # The health

    def _counters(self) -> dict[str, float]:
        window, tracks = self.outputs.features.window, self._tracks.tracks.values()
        own = {
            "sent": window.sent,
            "processed": window.processed,
            "stored": window.stored,
            "model_version": max((track.model_version for track in tracks), default=0),
            "objects": len(self.commands.desired.objects),
            "time": max((track.time for track in tracks), default=0.0),
            "paused": float(self.commands.paused),
            "waiting": float(not self.commands.desired.objects),
            "ended": float(self.process.ending.ended),
        }
        if self._source is not None:
            (own["width"], own["height"]), own["rate"] = self._source.size, self._source.rate
            own["start"], own["stride"] = self.process.job.part.start or 0, self.process.job.part.step or 1
            if self._source.zero is not None:  # as Unix time, which other machines have as well
                own["zero_time"] = time() - monotonic() + self._source.zero
        return own | self._source_counters()

    def _source_counters(self) -> dict[str, float]:
        """The counters of the source; frames that were skipped while the run was paused are included."""
        counters = self._source.counters if self._source is not None else {}
        if "skipped" in counters:
            counters["skipped"] += self._skipped
        return counters

    def _object_counters(self) -> dict[str, dict[str, float]]:
        """The counters of each object. While no frames are tracked, it is not known where it is."""
        objects = self.commands.desired.objects
        tracks = {name: track for name, track in self._tracks.tracks.items() if name in objects}
        counters = {name: {"model_version": float(track.model_version)} for name, track in tracks.items()}
        if run_state(self._counters())[0] == "running":
            for name, track in tracks.items():
                counters[name] |= {"score": track.score, "present": float(track.box is not None)}
        return counters


class Models:
    """The newest model of each object, from the trainer.

    early  models that arrived before their objects begin again, after a restart
    """

    def __init__(self, detectors: Detectors, subscriber: Subscriber[Model]) -> None:
        self._detectors = detectors
        self.receive_all = subscriber.receive_all
        self.early: dict[str, Model] = {}

    def receive(self, seconds: float, *, keep: bool) -> None:
        """Adopt the models that arrive within so many seconds; `keep` models of objects that have not begun yet."""
        for model in self.receive_all(seconds):
            if model.object in self._detectors.detectors:
                self._detectors.adopt(model)
            elif keep:
                self.early[model.object] = model

    def adopt_early(self, names: Iterable[str]) -> None:
        """Adopt the models of the objects that have begun."""
        for name in self.early.keys() & names:
            self._detectors.adopt(self.early.pop(name))
