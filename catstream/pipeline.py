"""The pipeline: detector, compressor and trainer as processes of this machine, and their tracks in order.

for track in catstream.Pipeline("walk.mp4", {"anna": (120, 80, 64, 48), "ben": (300, 90, 60, 150)}):
    print(track.object, track.frame, track.state, track.box)
"""

from __future__ import annotations

import math
import os
import time
import warnings
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

from catstream.base.addresses import without_password
from catstream.base.forks import check_not_forked, forked, generation
from catstream.errors import ObjectError, ServiceError, SettingsError
from catstream.processes.start_server import start_server

if TYPE_CHECKING:  # the methods import them, so that the constructor starts the server first
    from catstream.base.names import Boxes
    from catstream.base.settings import Settings
    from catstream.output.destinations import Header
    from catstream.processes.job import Job, Models, Results
    from catstream.processes.supervisor import Supervisor
    from catstream.wire.messages import RunState, Track

_ONCE = "a pipeline runs once, and this one has run: make another Pipeline to track the source again"
_ALL_FRAMES = slice(None)


class Pipeline:
    """Tracks objects with three processes, and yields exactly one `Track` for each object and frame.

    Iterate over it: the processes are started, and stopped at the end of the loop. Use it in a `with` to read its
    endpoint and its counters too, and to iterate over it in parts. A pipeline runs once; make another one to track the
    source again. In an event loop, wait for its tracks with `asyncio.to_thread`.

    A process that dies or hangs is restarted, and the run continues, however long the loop takes with each track.
    Backpressure: on a file, a slow consumer blocks the detector; on a live source, frames are skipped and counted. A
    live source has no end, and is opened again whenever it is lost.

    Parameters
    ----------
    source : str, path or int
        A video file, a folder of images, a pattern such as `images/%05d.png`, a camera (`0`), a stream
        (`rtsp://...`), or a live demo (`demo:1`).
    box : str, four numbers, or a mapping of names to such boxes
        x, y, w, h of the object in the first frame, in pixels: `(120, 80, 64, 48)` or `"120,80,64,48"`; of several
        objects by name: `{"anna": (120, 80, 64, 48), "ben": (300, 90, 60, 150)}`. Without a box or a model, the run
        waits for the box that `catstream.control` gives: a file stays at its first frame, a live source continues.
    settings : Settings or mapping of str
        All settings; or by name, the settings that differ from the defaults, or from the run that is resumed.
    model : path, or a mapping of names to paths
        File that `catstream save` wrote. The object is searched for, and absent until it is found; learning continues
        from the file.
    part : slice
        The frames of a file or folder to track: `slice(100, 200, 2)` for 100, 102 ... 198.
    state : path
        Folder for checkpoints, written every two seconds and at the end, from which the run can be resumed.
    resume : path
        State folder of an earlier run, which continues at the frame that it had reached. The folder also contains the
        source, the box, the part and the settings.
    after : int
        With `resume`: `frame` of the last track that the caller has; the run continues with the next one. If None, it
        continues after the last checkpoint, which may be ahead of the tracks that were read.
    paused : bool
        Whether the run starts paused: `catstream resume` continues it, for example once all subscribers are there.
    results : Results
        The files that the program writes, stored in the state folder for the program that resumes the run. A run that
        is resumed continues its files of each kind without a new one.
    save_model : path, or a mapping of names to paths
        Files for what was learned of the objects, written as by `catstream save` once the processes have ended, however
        the run ended. One path is for the only object. By default the files of `results`.

    Attributes
    ----------
    name : str
        Name of the source.
    frames : int or None
        Number of frames of the source, None if it is not known.
    rate : float
        Frames per second of the source.
    size : tuple of int
        Width and height of a frame.
    live : bool
        Whether the source is a camera or a stream.
    source, boxes, part, settings
        The values of the run, also if it is resumed; the path of a source is absolute.
    state : Path or None
        The folder of the state, absolute; None without one.
    results, earlier_results : Results
        The files that the program writes, including those of the resumed run; and the files of the resumed run alone.
    first_frame : int or None
        With `resume`: number of the next frame that the caller needs, `after` + 1. It may be set before the start.
    first_time : float
        Time of the caller's last frame, in seconds; the times of a live source continue after it.
    saved_models : list of Path
        At the end: the files of `save_model` that were written.

    Raises
    ------
    BoxError, ObjectError, VideoError
        From the constructor, if a box is not in the frame, a name is not valid, there are too many objects, or the
        source cannot be read.
    SettingsError
        From the constructor, if the settings do not suit the source: a live one in lockstep.
    ServiceError, ProtocolError
        From the constructor, if the model cannot be read, a file of `save_model` cannot be written, the folder to
        resume contains no run or a damaged one, or the folder of the state contains a run.
    ServiceError
        At the start, if the endpoint or the state folder is in use, or if the pipeline has run already. While
        iterating, if a process fails repeatedly, or another thread closes the pipeline.
    VideoError
        While iterating, if the source fails, after its last valid frame.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | int | None = None,
        box: Boxes | None = None,
        settings: Settings | Mapping[str, object] | None = None,
        *,
        model: Models | None = None,
        part: slice = _ALL_FRAMES,
        state: str | os.PathLike[str] | None = None,
        resume: str | os.PathLike[str] | None = None,
        after: int | None = None,
        paused: bool = False,
        results: Results | None = None,
        save_model: Models | None = None,
    ) -> None:
        _check_exclusive(state, resume, box, model)
        start_server()  # it imports while this process imports and opens the source
        from catstream.base.names import UNNAMED
        from catstream.processes.job import Job, Results
        from catstream.processes.probe import probe
        from catstream.processes.state import check_new
        from catstream.video.source import source_text

        text = None if source is None else source_text(source)
        self._earlier: Job | None = None
        self.state = None if state is None else Path(state).absolute()
        if self.state is not None:
            check_new(self.state)
        if resume is None:
            job = Job.new(text, box, settings, models=model, part=part, results=results, paused=paused)
        else:
            self._earlier, self.state = Job.load(Path(resume)), Path(resume).absolute()
            job = self._earlier.resumed(text, settings, part=part, results=results, paused=paused)
        self._save_models = job.results.models if save_model is None else _writable(save_model)
        if UNNAMED in self._save_models and len(job.boxes) + len(job.models) > 1:
            raise ObjectError("a saved model without a name is for a single object: pass NAME=FILE for each of several")
        job, info = probe(job)
        self._job = job
        if self._earlier is not None and self.state is not None:
            self._earlier.check_fits(job, self.state)
        self.name, self.frames, self.rate, self.size, self.live = info
        self.source, self.boxes, self.part, self.settings = job.source, job.boxes, job.part, job.settings
        self.results, self.earlier_results = job.results, self._earlier.results if self._earlier else Results()
        self.saved_models: list[Path] = []
        self.first_frame = None if after is None else after + 1
        self.first_time = 0.0
        self._life: Literal["new", "open", "closed"] = "new"
        self._stack = ExitStack()  # cleans up at the end
        self._supervisor: Supervisor | None = None  # None before the start
        self._rows = 0  # number of tracks that were received
        self._rest: deque[Track] = deque()  # tracks of the last frame that were not yielded yet

    def __enter__(self) -> Self:
        if self._life != "new":
            raise ServiceError(_ONCE)
        from catstream.processes.state import locked_for_run, saved
        from catstream.processes.supervisor import Supervisor
        from catstream.wire.discovery import private_folder, reserve_endpoint

        with ExitStack() as stack:
            folder = stack.enter_context(private_folder())
            settings, source = self.settings, without_password(self.source)
            endpoint = stack.enter_context(reserve_endpoint(settings.run.endpoint, folder, settings.run.keys, source))
            if self.state is not None:
                stack.enter_context(locked_for_run(self.state, self._earlier, self._job))
            self._job, first = self._started(str(endpoint))
            state = self.state or folder
            stack.enter_context(saved(self._save_models, state, settings, self.saved_models.append))
            self._supervisor = Supervisor(self._job, folder, first)
            stack.callback(self._supervisor.stop)  # before the models are saved, from the compressor's last checkpoint
            self._generation = generation()  # a copy of this process that is forked later does not end the run
            self._stack, self._life = stack.pop_all(), "open"
        return self

    def _started(self, endpoint: str) -> tuple[Job, int]:
        """The job for the processes that are started now, and the number of the last frame before.

        The caller or the checkpoint has that frame. The times of a live run continue. A pause between two parts of it
        does not count: nothing measures it if the clock of the machine was set meanwhile.
        """
        first, passed = 0, 0.0
        if self._earlier is not None and self.state is not None:
            from catstream.processes.state import position

            # Frames of a live source cannot be read again: the checkpoint may be ahead of the tracks.
            stored = position(self.state) if self.live or self.first_frame is None else (0, 0.0)
            first = max(stored[0], self.first_frame or 0)
            passed = max(stored[1], self.first_time) + self.settings.run.checkpoint_seconds
        job = replace(
            self._job,
            endpoint=endpoint,
            state=self.state,
            resume=self._earlier is not None,
            since=time.monotonic() - passed,
            first=first if self.live else 0,
        )
        return job, first

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        was_open, self._life = self._life == "open", "closed"
        if was_open and not forked(self._generation):
            self._stack.__exit__(kind, error, trace)

    def close(self) -> None:
        """Stop the processes in order, after they have stored everything. The pipeline cannot be started again."""
        self.__exit__(None, None, None)

    def __del__(self) -> None:
        if getattr(self, "_life", "new") == "open" and not forked(self._generation):
            text = f"{self!r} was not closed: use it in a `with`"
            self.close()
            warnings.warn(text, ResourceWarning, source=self, stacklevel=1)  # last: it may be an error

    def __repr__(self) -> str:
        life = f"at {self._job.endpoint}" if self._life == "open" else self._life
        return f"<catstream.Pipeline of {without_password(self.source)!r}, {life}>"

    def __iter__(self) -> Iterator[Track]:
        return self._run() if self._life == "new" else self._tracks()

    def _run(self) -> Iterator[Track]:
        with self:
            yield from self._tracks()

    def by_frame(self, seconds: float = math.inf) -> Iterator[dict[str, Track]]:
        """Iterate over the frames: the track of each object, by name. The pipeline must be used in a `with`.

        Parameters
        ----------
        seconds : float
            Time without a frame after which an empty mapping is returned, for a program with other work.

        Raises
        ------
        ServiceError
            If the pipeline was not started, or was closed.
        """
        while (tracks := self._next_frame(seconds)) is not None:
            yield tracks

    def _tracks(self) -> Iterator[Track]:
        """The tracks that arrive from now on; the loop before may have ended within a frame."""
        while True:
            while self._rest:
                yield self._rest.popleft()
            if (tracks := self._next_frame()) is None:
                return
            self._rest.extend(tracks.values())

    def _next_frame(self, seconds: float = math.inf) -> dict[str, Track] | None:
        """The track of each object in the next frame; empty if the time is over, None at the end."""
        tracks = self._running.next_frame(seconds)
        self._rows += len(tracks or ())
        return tracks

    def report_unwritten(self, frames: int, reason: str) -> None:
        """Report how many frames the program could not write so far, and why: "" once they are written again.

        `catstream status`, the health reports, the metrics and events include it.
        """
        self._running.report_unwritten(frames, reason)

    @property
    def _running(self) -> Supervisor:
        """The processes of the run, while it is open."""
        if self._life == "closed":
            raise ServiceError(_ONCE)
        if self._supervisor is None:
            raise ServiceError("the pipeline was not started yet: use it in a `with`, or iterate it")
        check_not_forked(self._generation)
        return self._supervisor

    @property
    def header(self) -> Header:
        """The header of the log of the run."""
        from catstream.output.destinations import Header

        stride = self.part.step or 1
        return Header(
            source=without_password(self.source),
            size=self.size,
            rate=self.rate * stride,
            frames=self.frames,
            start=self.part.start or 0,
            stride=stride,
            settings=tuple(self.settings.changed()),
            boxes=self.boxes,
        )

    @property
    def endpoint(self) -> str:
        """The address of the pipeline, for `catstream.subscribe` and `catstream.control`.

        Raises
        ------
        ServiceError
            If the pipeline was not started yet.
        """
        if not self._job.endpoint:
            raise ServiceError("a pipeline has no endpoint before it has started: use it in a `with`")
        return self._job.endpoint

    @property
    def totals(self) -> dict[str, int]:
        """At the end: the number of features messages that were `sent`, and `stored` in the coreset trees.

        And of the tracks that were received here (`rows`), and how often a process was restarted (`restarts`). If
        frames of a file were skipped, how many were `damaged`, and if they had
        another size than the first one, how many were `scaled`; of a live source, how many frames were `skipped`, and
        its number of `reconnects`.
        """
        if self._supervisor is None or self._supervisor.end is None:
            return {}
        own = {"rows": self._rows, "restarts": self.restarts}
        return {name: int(value) for name, value in self._supervisor.end.totals.items()} | own

    @property
    def reason(self) -> str:
        """At the end: why the stream ended; empty before."""
        return self._supervisor.end.reason if self._supervisor is not None and self._supervisor.end is not None else ""

    @property
    def health(self) -> dict[str, dict[str, float]]:
        """The counters of each process that were received last, by the name of the process."""
        reports = self._supervisor.health if self._supervisor is not None else {}
        return {name: health.counters for name, health in reports.items()}

    @property
    def trouble(self) -> dict[str, str]:
        """Descriptions of current problems, by the name of the process; empty if there are none."""
        reports = self._supervisor.health if self._supervisor is not None else {}
        return {name: health.trouble for name, health in reports.items() if health.trouble}

    @property
    def pids(self) -> dict[str, int]:
        """Process ids of the running processes, by name."""
        if self._supervisor is None:
            return {}
        check_not_forked(self._generation)
        return self._supervisor.pids

    @property
    def restarts(self) -> int:
        """How many times a process was restarted."""
        return self._supervisor.restarts if self._supervisor is not None else 0

    @property
    def lost_seconds(self) -> float:
        """For how long a live source has been lost, 0 if it is not lost."""
        return self.health.get("detector", {}).get("lost_seconds", 0.0)

    @property
    def holding(self) -> RunState | Literal[""]:
        """Reason for which no frames are tracked: the source is "lost", or the run is "waiting" for a box or "paused".

        Empty if they are tracked, and before the detector has reported it.
        """
        from catstream.wire.messages import run_state

        state, _ = run_state(self.health.get("detector", {}))
        return "" if state in ("running", "ended") else state


def _check_exclusive(state: object, resume: object, box: object, model: object) -> None:
    """Raise SettingsError for arguments that exclude each other."""
    if state is not None and resume is not None:
        raise SettingsError("state and resume are mutually exclusive (new run / existing run)")
    if resume is not None and not (box is None and model is None):
        raise SettingsError(
            "a resumed run keeps its objects: omit box and model, and add others with catstream set-box or "
            "catstream search once it runs"
        )


def _writable(files: Models) -> dict[str, Path]:
    """The files of saved models by name, absolute, because the program may change its current folder during the run.

    ServiceError if one cannot be written.
    """
    from catstream.base.files import check_distinct, check_file
    from catstream.processes.job import files_by_name

    paths = {name: file.absolute() for name, file in files_by_name(files).items()}
    check_distinct((f"the saved model of {name or 'the object'}", path) for name, path in paths.items())
    for path in paths.values():
        check_file(path)
    return paths
