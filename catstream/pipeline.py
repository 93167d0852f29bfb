"""The pipeline: detector, compressor and trainer as processes of this machine, and their tracks in order.

with catstream.Pipeline("walk.mp4", (120, 80, 64, 48)) as pipeline:
    for track in pipeline:
        print(track.frame, track.state, track.box)
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from catstream.box import Box
from catstream.errors import RecordingError, ServiceError, SettingsError, VideoError
from catstream.learned import Learned
from catstream.messages import End, Health, Position, Track
from catstream.services.supervisor import Supervisor
from catstream.settings import Settings
from catstream.state import Origin, began, held, position
from catstream.video.frames import without_password
from catstream.video.source import WHOLE, is_live, open_source
from catstream.wire.endpoint import meeting_place, private_folder
from catstream.wire.sockets import Receiver, Subscriber

__all__ = ["Pipeline"]

_CHECK_SECONDS = 0.1
_FAREWELL_SECONDS = 12.0

_log = logging.getLogger(__name__)


class Pipeline:
    """Runs the processes while it is open; iterate it for one `Track` a frame, none missing.

    A process that dies is restarted, and the run goes on. Who takes tracks slowly slows a
    file down: the detector waits. A live source never waits: the frames that pass meanwhile are
    skipped and counted. It has no end, and is opened again whenever it is lost.

    Parameters
    ----------
    source : a video file, a folder of images, a pattern, a camera, a stream: see `catstream.video.source`
    box : x, y, w, h of the object in the first frame, in pixels; with neither this nor a model the
        first frame is held, or those of a live source pass by, until `catstream.control` sets a box
    settings : or names and values of those that are not by default; where a run goes on, of those that are to be others
    model : file that `catstream save` wrote: the object is searched for, absent until it is found, and
        learning goes on from there
    part : which frames of a file or folder there are to follow, `slice(100, 200, 2)` for 100, 102 ... 198
    record : file to write all that travels to, see `catstream.recording`; no features are missing there
    state : folder to keep what was learned in, so that a power cut does not end the run: once a second, and at the end
    resume : folder of an earlier run to go on with, where it was. Source, box, part and settings are
        kept there too: give those only that are to be others
    notes : names and texts to keep there, for whoever goes on

    Attributes
    ----------
    name, frames, rate, size, live : of the source, as `catstream.video.frames.Source` has them
    source, part, notes : as they were given, or kept
    after : where a run that is resumed goes on, to be set before it is entered: after the last track that the caller
        has. Where None, after the last frame that was learned from: tracks of the last second may come again

    Raises
    ------
    BoxError, VideoError
        From the constructor, for a box that is not in the frame or a source that cannot be read.
    RecordingError
        From the constructor, where the file to record to is there already.
    SettingsError
        From the constructor, for settings that the source cannot be followed with: a live one in lockstep.
    ServiceError, ProtocolError
        From the constructor, for a model that cannot be read; where nothing was kept in the folder to resume, or it
        is damaged.
    ServiceError
        On entering, where the endpoint or the folder of the state is in use. While iterating, where a process
        cannot be kept alive.
    VideoError
        While iterating, where the source breaks, after its last good frame.
    """

    def __init__(
        self,
        source: str | None = None,
        box: Sequence[float] | None = None,
        settings: Settings | Mapping[str, Any] | None = None,
        *,
        model: str | os.PathLike[str] | None = None,
        part: slice = WHOLE,
        record: str | os.PathLike[str] | None = None,
        state: str | os.PathLike[str] | None = None,
        resume: str | os.PathLike[str] | None = None,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        if state is not None and resume is not None:
            raise SettingsError("a run is begun in a folder (state) or goes on in one (resume): give one of them")
        self._kept = Origin.load(Path(resume)) if resume is not None else None
        self._state = Path(state or resume or "") if state or resume else None
        self.part, self.notes = part, dict(notes or {})
        self.after: Position | None = None
        if self._kept is not None:
            source = source or self._kept.source
            if box is None and model is None:
                box, model = self._kept.box, self._kept.model or None
            self.part = self._kept.part if part == WHOLE else part
            self.notes = self._kept.notes | self.notes
        given = settings.changed() if isinstance(settings, Settings) else settings or {}
        self.settings = (self._kept.settings if self._kept is not None else Settings()).but(given)
        if source is None:
            raise SettingsError("a new run needs a source: give one")
        self.source = str(source)
        self._box = Box(*map(float, box)) if box is not None else None
        self._record = None if record is None else Path(record)
        self._model = Path(model) if model is not None else None
        if self._box is not None and self._model is not None:
            raise SettingsError("a box says where the object is, with a model it is searched for: give one of them")
        if self._model is not None:
            Learned.load(self._model)
        self._end: End | None = None
        self._health: dict[str, Health] = {}
        if self.settings.lockstep and is_live(self.source):
            raise SettingsError("a live source does not wait, and no run of it can be repeated: leave lockstep away")
        if self._record is not None and self._record.exists() and self._kept is None:
            raise RecordingError(f"{record} is there already: give another name, or remove it")
        # The detector opens the source once more: a camera shows its picture to one at a time.
        image_rate, skip_damaged = self.settings.image_rate, self.settings.skip_damaged
        with open_source(self.source, part=self.part, image_rate=image_rate, skip_damaged=skip_damaged) as first:
            self.name, self.frames, self.rate, self.size = first.name, first.frames, first.rate, first.size
            self.live = first.live
        if self._box is not None:
            self._box.inside(*self.size)
        self.settings = self.settings.for_length(self.frames)
        path = self.source if self.live else str(Path(self.source).absolute())
        started = self._kept.started if self._kept else time.time()
        kept = str(self._model.absolute()) if self._model is not None else ""
        self._origin = Origin(path, self._box, self.part, self.settings, self.size, started, self.notes, kept)
        if self._kept is not None and self._state is not None:
            self._kept.check(self._state, self._origin)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            folder = stack.enter_context(private_folder())
            source = without_password(self._origin.source)
            endpoint = stack.enter_context(meeting_place(self.settings.endpoint, folder, self.settings.keys, source))
            self.endpoint = str(endpoint)
            state = stack.enter_context(self._begun(self._state)) if self._state is not None else None
            start = self._start(state) if state is not None and self._kept is not None else Position()
            self._box = start.box or self._box
            self._results = stack.enter_context(Receiver("results", endpoint, start, self.settings.window))
            self._reports = stack.enter_context(Subscriber("health", endpoint))
            settings = replace(self.settings, endpoint=self.endpoint)
            self._supervisor = Supervisor(
                self.source,
                self._origin.box,
                settings,
                folder,
                model=self._model,
                owned=True,
                part=self.part,
                record=self._record,
                state=state,
                resume=self._kept is not None,
                since=time.monotonic() - max(0.0, time.time() - self._origin.started),
            )
            stack.callback(self._supervisor.stop)
            stack.callback(self._listen)  # also to what came since the last track, before Ctrl-C
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __iter__(self) -> Iterator[Track]:
        checked = 0.0
        while self._end is None:
            message = self._results.receive(_CHECK_SECONDS)
            if isinstance(message, Track):
                self._results.acknowledge(Position(message.seq, message.frame, message.box or self._box))
                self._box = message.box or self._box
                yield message
            elif isinstance(message, End):
                self._results.acknowledge(Position(message.seq))
                self._end = message
            if time.monotonic() - checked > _CHECK_SECONDS:
                checked = time.monotonic()
                self._watch()
        self._wait()
        if self._end.failed:
            raise VideoError(self._end.reason)

    @property
    def totals(self) -> dict[str, int]:
        """At the end: how many features were `sent`, and `stored` in the coreset trees."""
        return {name: int(value) for name, value in self._end.totals.items()} if self._end else {}

    @property
    def health(self) -> dict[str, dict[str, float]]:
        """The latest counters of each process that came while iterating or by the end, by its name."""
        return {name: health.counters for name, health in self._health.items()}

    @property
    def trouble(self) -> dict[str, str]:
        """What is wrong with a process, for a person, by its name; of those with which something is."""
        return {name: health.trouble for name, health in self._health.items() if health.trouble}

    @property
    def pids(self) -> dict[str, int]:
        """Process id by name."""
        return self._supervisor.pids

    @property
    def restarts(self) -> int:
        """How often a process died and was restarted."""
        return self._supervisor.restarts

    @property
    def lost_seconds(self) -> float:
        """For how long a live source has been lost, 0 while it is not."""
        return self.health.get("detector", {}).get("lost_seconds", 0.0)

    @property
    def waits(self) -> bool:
        """Whether it begins by waiting for a box; one that goes on may have one by now."""
        return self._box is None and self._model is None and self._kept is None

    @property
    def holding(self) -> str:
        """Why no frame is followed though there are some, empty where they are: "paused", or "waiting" for a box."""
        told = self.health.get("detector", {})
        return next((name for name in ("waiting", "paused") if told.get(name)), "")

    @contextmanager
    def _begun(self, folder: Path) -> Iterator[Path]:
        """Hold the folder of the state, and say there how the pipeline was started."""
        with held(folder) as state:
            if self._kept is None and began(state):
                raise ServiceError(
                    f"a pipeline was kept in {str(folder)!r} already: go on with it (--resume {folder}), "
                    "or give another folder"
                )
            if self._origin != self._kept:
                self._origin.save(state)
            yield state

    def _start(self, state: Path) -> Position:
        """After which track to go on."""
        if self.after is not None and not self.live:
            return self.after
        # The frames of a live source cannot be had again: what was learned from is not lost, though no track tells.
        learned = position(state, self.settings)
        return max(learned, self.after or learned, key=lambda start: start.seq)

    def _watch(self) -> None:
        self._listen()
        self._supervisor.check()
        if self.live:  # when it is lost, why, and when it is back
            for line in self._supervisor.news("detector"):
                _log.warning("%s", line)
        if self._supervisor.finished:
            raise ServiceError("the processes ended before the video did: this should not happen, please report it")

    def _listen(self) -> None:
        for health in self._reports.waiting():
            before = self._health.get(health.process)
            if health.trouble and (before is None or before.trouble != health.trouble):
                _log.warning("%s: %s", health.process, health.trouble)
            self._health[health.process] = health

    def _wait(self) -> None:
        """For the detector to hear that its end is stored, though it may have to be told twice, and to end."""
        deadline = time.monotonic() + _FAREWELL_SECONDS
        while not self._supervisor.finished and time.monotonic() < deadline:
            self._results.receive(0.01)
            self._listen()
            self._supervisor.check()
        self._listen()
