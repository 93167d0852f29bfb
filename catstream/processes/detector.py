"""The process that tracks the objects in each frame with their newest models, and sends tracks and features.

`main` lists the steps for one frame; `DetectorLoop` implements them. Commands, new objects and outputs have separate
modules. The decisions are pure functions in `catstream.processes.decisions` and `catstream.processes.control_commands`.
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
from catstream.processes.commands import Commands
from catstream.processes.decisions import TrainingLag, have_arrived, resume_at
from catstream.processes.initialization import Initialized, Initializer
from catstream.processes.outputs import Outputs
from catstream.processes.process import POLL_SECONDS, Process
from catstream.processes.shared import LONG_SECONDS
from catstream.video import source as video_source
from catstream.video.frames import Frame, Source, read_ahead
from catstream.video.source import open_source
from catstream.wire.channels import MODELS
from catstream.wire.messages import Features, Model, Track, Tracks, run_state
from catstream.wire.newest import Subscriber

_SKIP_SECONDS = 0.1  # watchdog limit for decoding a skipped frame
_LONGEST_SOURCE = 1000  # maximum number of characters of the source in the health

for module in (video_source, ridge):
    module.prepare()  # imports a library, once in the start server instead of in each process
_log = logging.getLogger(__name__)


def main(process: Process) -> None:
    """Track the objects of the job to the last frame of its source."""
    with ExitStack() as stack:
        loop = DetectorLoop(process, stack)
        if process.job.resume and not loop.resume():
            return  # a signal arrived
        try:
            for frame in loop.frames(stack):
                loop.poll()  # executes commands, serves late joiners, publishes the health
                initialized = loop.initialize(frame)  # while paused, a file source blocks here
                if not loop.skips(initialized):
                    tracks, features = loop.track(frame, initialized)
                    loop.outputs.send(tracks, features)  # blocks while a window is full
                    loop.wait_for_models()  # blocks while training lags behind by more than `lag_frames`
                if process.ending.reason:
                    break
            process.ending.begin("the source has ended")
        except VideoError as error:
            process.ending.begin(str(error), failed=True)
            _log.error("%s", error)
        loop.end()


class DetectorLoop:
    """The detectors of a stream, connected to its source, its commands, its models and its outputs.

    Every method that blocks calls `poll` repeatedly.
    """

    def __init__(self, process: Process, stack: ExitStack) -> None:
        cv2.setNumThreads(1)
        stack.callback(process.watchdog.allow)
        # A file name need not be UTF-8.
        process.source = without_password(process.job.source).encode(errors="replace").decode()[:_LONGEST_SOURCE]
        self.process = process
        self.detectors = Detectors(process.settings)
        self.lag = TrainingLag()
        self.commands = stack.enter_context(Commands(process, self.detectors))
        self.outputs = stack.enter_context(Outputs(process, self.poll, self.lag.reply))
        self.models = Models(self.detectors, stack.enter_context(Subscriber(MODELS, process.endpoint)))
        self.initializer = Initializer(process, self.detectors, self.commands, self.outputs.previews)
        self._source: Source | None = None
        self._is_lost = False  # whether a live source was lost at the last `poll`
        self._skipped = 0  # frames skipped because the run was paused or waited for a box
        self._tracks = Tracks(0, {})  # of the last frame

    def poll(self) -> None:
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
        """Continue after the last frame of compressor and consumer; returns False after a signal."""
        process, commands, features = self.process, self.commands, self.outputs.features
        after = process.consumer.after if process.consumer is not None else None
        models: dict[str, Model] = {}
        # Step 1: wait for the compressor's position, and for the models of its newest samples.
        while True:
            position = features.ask_position(after)
            models |= {model.object: model for model in self.models.receive_all(POLL_SECONDS)}
            versions = {name: model.version for name, model in models.items()}
            if position is not None and have_arrived(position, commands.desired, versions):
                break
            self._serve()
            if process.ending.reason:
                return False
        # Step 2: restore detectors, window and desired state at the frame from which to continue.
        start = resume_at(position, after, commands.desired, live=self._live)
        self.detectors.seq = self.lag.processed = start.seq
        self.initializer.resume(start, models)
        self.models.early = {name: model for name, model in models.items() if name not in start.states}
        features.window.resume(start.seq, position)
        commands.resume(start)
        return True

    def frames(self, stack: ExitStack) -> Iterator[Frame]:
        """The frames of the source from the next one on. A file is opened at the previous frame, which exists."""
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
            self._source.size = job.size or self._source.size  # a camera's size may differ from the start of the run
        frames = self._source if self._live else stack.enter_context(closing(read_ahead(self._source)))
        return (frame for frame in frames if frame.number >= self.detectors.seq)

    def _idle(self) -> bool:
        """Poll while a live source provides no frame; returns True to stop waiting."""
        self.poll()
        if self._is_lost:
            self.commands.reject_boxes("the source is lost, so a box has no frame: try again once it is reconnected")
        return bool(self.process.ending.reason)

    # A frame

    @property
    def _suspended(self) -> bool:
        """True if no frames are tracked: the stream ends, or the run is paused or waits for a box."""
        return bool(self.process.ending.reason) or self.commands.suspended

    def initialize(self, frame: Frame) -> list[Initialized]:
        """Initialize the objects that begin in a frame.

        While the run is paused or has no object, a file source blocks here until there is a box or the run resumes.
        """
        initialized = self.initializer.in_frame(frame, suspended=self._suspended)
        if self.commands.suspended and not initialized:
            # Show the tracked objects while a box is drawn. On a live source, their positions are out of date.
            self._show(self.detectors.seq, frame, {} if self._live else self._tracks.tracks)
        while self.commands.suspended and not (initialized or self.process.ending.reason or self._live):
            sleep(POLL_SECONDS)
            self.poll()
            initialized = self.initializer.in_frame(frame, suspended=self._suspended)
        return initialized

    def skips(self, initialized: Sequence[Initialized]) -> bool:
        """Return True if a frame is not tracked: the stream ends, or a live source is paused."""
        skips = self._suspended and not initialized
        self._skipped += skips and not self.process.ending.reason
        return skips

    def track(self, frame: Frame, initialized: Iterable[Initialized]) -> tuple[Tracks, Features]:
        """Track all objects in a frame, in which some were `initialized`."""
        results = {item.name: item.result for item in initialized if item.result is not None}
        saved = {item.name: item.model for item in initialized if item.model is not None}
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
        """Wait until the models are recent enough, see `TrainingLag.awaited`; a live source does not wait."""
        run = self.process.settings.run
        required = self.detectors.seq - (0 if run.lockstep else run.lag_frames)  # newest message that needs training
        while not (self.process.ending.reason or self._live):
            detectors = self.detectors.detectors.items()
            newest = {
                name: detector.newest_version
                for name, detector in detectors
                if detector.state and detector.state.first_frame < required
            }
            channel = self.lag.awaited(required, newest)
            if not channel:
                return
            if channel == "features":
                self.outputs.features.poll(POLL_SECONDS)
            else:
                self._receive_models(POLL_SECONDS)
            self.poll()

    def _show(self, number: int, frame: Frame, tracks: Mapping[str, Track]) -> None:
        """Show a frame with the boxes of the desired objects to subscribers of previews."""
        boxes = {name: track.box for name, track in tracks.items() if name in self.commands.desired.objects}
        present = {name: box for name, box in boxes.items() if box is not None}
        self.outputs.previews.show(number, frame, present)

    # The end

    def end(self) -> None:
        """Send the end of the stream to the compressor and, once all messages are stored, to all other receivers."""
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
            if self._source.zero is not None:  # as Unix time, for other machines
                own["zero_time"] = time() - monotonic() + self._source.zero
        return own | self._source_counters()

    def _source_counters(self) -> dict[str, float]:
        """The counters of the source, including frames that were skipped while the run was paused."""
        counters = self._source.counters if self._source is not None else {}
        if "skipped" in counters:
            counters["skipped"] += self._skipped
        return counters

    def _object_counters(self) -> dict[str, dict[str, float]]:
        """The counters of each object. While no frames are tracked, its position is unknown."""
        objects = self.commands.desired.objects
        tracks = {name: track for name, track in self._tracks.tracks.items() if name in objects}
        counters = {name: {"model_version": float(track.model_version)} for name, track in tracks.items()}
        if run_state(self._counters())[0] == "running":
            for name, track in tracks.items():
                counters[name] |= {"score": track.score, "present": float(track.box is not None)}
        return counters


class Models:
    """Receives the newest model of each object from the trainer."""

    def __init__(self, detectors: Detectors, subscriber: Subscriber[Model]) -> None:
        self._detectors = detectors
        self.receive_all = subscriber.receive_all
        self.early: dict[str, Model] = {}  #: models of objects that have not begun again yet after a restart

    def receive(self, seconds: float, *, keep: bool) -> None:
        """Adopt the models that arrive within `seconds`; `keep` models of objects that have not begun yet."""
        for model in self.receive_all(seconds):
            if model.object in self._detectors.detectors:
                self._detectors.adopt(model)
            elif keep:
                self.early[model.object] = model

    def adopt_early(self, names: Iterable[str]) -> None:
        """Adopt the models of the objects that have begun."""
        for name in self.early.keys() & names:
            self._detectors.adopt(self.early.pop(name))
