"""`catstream.annotate`: tracks objects between boxes that a person has drawn at keyframes of a video."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self, cast

import msgspec
import numpy as np

from catstream.base.addresses import is_live, without_password
from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.files import writing
from catstream.base.names import UNNAMED, check_count, check_name, errors_about
from catstream.base.settings import Settings
from catstream.base.text import listed
from catstream.base.threads import cores
from catstream.base.workers import Workers
from catstream.errors import BoxError, ObjectError, ProtocolError, VideoError
from catstream.offline.fusion import fuse
from catstream.offline.keyframes import HIDDEN, KeyframeBox, parse_box
from catstream.offline.object_tracks import CHECKED, ObjectTracks
from catstream.offline.passes import PAUSED, Pass, box_of, row_of, run_pass
from catstream.video.source import ALL_FRAMES
from catstream.video.video_frames import VideoFrames
from catstream.wire import storage
from catstream.wire.messages import Check

#: Called with the name of an activity, the number of finished frames, and the total number; None if it is unknown.
Progress = Callable[[str, int, int | None], object]

#: Boxes by frame, None where the object is absent, "hidden" where it is too occluded for a box: of one object without a
#: name, or by name.
_BoxesByFrame = Mapping[int, str | Iterable[float] | None]
KeyframeBoxes = _BoxesByFrame | Mapping[str, _BoxesByFrame]


class NextFrame(NamedTuple):
    """The frame to annotate next, and the object.

    errors  expected number of wrong frames in its stretch
    """

    frame: int
    object: str
    errors: float


@dataclass(frozen=True, slots=True)
class Task:
    """A pass to be tracked, with the box at `start` or, with a memory, all boxes of the object."""

    object: str = field(compare=False)  # the pass depends only on the boxes
    start: int
    stop: int
    keyframes: tuple[tuple[int, Box | None], ...]
    use_memory: bool

    @property
    def frames(self) -> int:
        return abs(self.start - self.stop)


class _Stretch(NamedTuple):
    """The frames of an object between two keyframes, or between a keyframe and an end of the video."""

    object: str
    start: int
    stop: int  # the frame after the last one


class Annotation:
    """The keyframes of the objects of a video, and the tracks between them.

    Call `track` after the constructor, which only opens the video; `annotate` does both. Each stretch between two
    keyframes is tracked from both ends. If frames remain unchecked, it is tracked from both ends again, with the merged
    model of all other boxes of the object. `add` tracks only the stretches next to its box; earlier passes are used as
    far as they agree with the boxes. A pass does not begin or end in a frame where the object is hidden.
    Close the annotation, or use it in a `with`, to end its processes. Frames are decoded from the video when needed.

    Parameters
    ----------
    video : path of a file or a folder of images
    boxes : mapping of frame to box, or of object to such a mapping
        Frames count from 0; a box is None where the object is absent, "hidden" where it is occluded.
    settings : Settings or mapping of str
        The settings that differ from the defaults.
    part : slice of the frames of the video, which are then renumbered from 0; by default all
    jobs : number of processes; None for the number of cores
    progress : function that is called during the work, see `Progress`

    Attributes
    ----------
    frames : VideoFrames
    keyframes : dict of the boxes of each object, by name and frame
    stored : file of finished passes, see `save_passes`, which `scan` reads; None to store nothing
    progress : see the parameters

    Raises
    ------
    VideoError
        If the video is live or cannot be read; by `track` also if a frame cannot be decoded.
    BoxError
        For a box outside its frame; by `scan` and `track` also for a frame beyond the end of the video.
    ObjectError
        For an invalid name, an object without a box, or too many objects.
    """

    def __init__(
        self,
        video: str | os.PathLike[str],
        boxes: KeyframeBoxes,
        settings: Settings | Mapping[str, object] | None = None,
        *,
        part: slice = ALL_FRAMES,
        jobs: int | None = None,
        progress: Progress = lambda *_: None,
    ) -> None:
        self.settings = Settings().replace(settings)
        self._jobs, self.progress, self._part, self._video = jobs or cores(), progress, part, Path(video)
        self.stored: Path | None = None
        if is_live(os.fspath(video)):
            redacted = without_password(os.fspath(video))
            raise VideoError(f"cannot annotate a live source ({redacted}): record it to a file first")
        self._passes: dict[Task, Pass | None] = {}  # None if a pass cannot start
        self._fusions: dict[_Stretch, tuple[Float64, Float64, Float64]] = {}  # cached results of `fuse`
        self._workers = Workers(self._jobs)
        self._folder = tempfile.TemporaryDirectory(prefix="catstream-annotate-", ignore_cleanup_errors=True)
        try:
            self.frames = VideoFrames(os.fspath(video), part, self.settings.run)
            self._is_scanned = False
            self.set_boxes(boxes)
        except BaseException:
            self._folder.cleanup()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        count = sum(map(len, self.keyframes.values()))
        return f"<catstream.Annotation of {self.frames.name}: {count} boxes, {self.share_checked:.0%} checked>"

    def stop(self) -> None:
        """End the processes and close the video; methods that need them start and open them again."""
        self._workers.kill()
        self.frames.close()

    def close(self) -> None:
        """End the processes and close the video; `add` and `track` can no longer be called."""
        self.stop()
        self._folder.cleanup()

    def add(self, frame: int, box: str | Iterable[float] | None, object: str = UNNAMED) -> None:
        """Add or replace the box of an object at a frame, and track the stretches next to it.

        The box and the errors are as in the constructor.
        """
        name = check_name(object)
        drawn: _BoxesByFrame = {**self.keyframes.get(name, {}), frame: box}
        self.set_boxes({**self.keyframes, name: drawn})
        self.track()

    def set_boxes(self, boxes: KeyframeBoxes) -> None:
        """Replace the boxes of all objects, without tracking; the errors are as in the constructor."""
        parsed = _parsed(boxes)
        check_count(len(parsed), self.settings.run.max_objects)
        self._check(parsed)
        for stretch in [*self._fusions]:
            if parsed.get(stretch.object) != self.keyframes[stretch.object]:
                del self._fusions[stretch]
        self.keyframes: dict[str, dict[int, KeyframeBox]] = parsed
        self._drawn = {
            name: {frame: box for frame, box in boxes.items() if box != HIDDEN} for name, boxes in parsed.items()
        }

    def scan(self, *, exact: bool = False) -> None:
        """Number the frames, unless this was done; `exact` is as in `VideoFrames.scan`.

        VideoError if a frame cannot be decoded: `track` uses the frames before it.
        """
        if exact or not self._is_scanned:
            self._is_scanned = True
            self._passes.clear()
            self._fusions.clear()
            self.progress("reading", len(self.frames), None)
            try:
                self.frames.scan(lambda *done: self.progress("reading", *done), exact=exact)
            except BaseException as error:
                self._is_scanned = isinstance(error, VideoError)  # otherwise `progress` has interrupted it
                raise
            self._load_passes()
        self._check(self.keyframes)

    def track(self) -> None:
        """Run the missing passes. After an interruption, the finished passes remain."""
        self.scan()
        while tasks := self.missing():
            total, finished = sum(task.frames for task in tasks), 0
            work = [(task, self.frames, self.settings, Path(self._folder.name)) for task in tasks]
            results = self._workers.run(_work, work) if self._jobs > 1 else (_work(*task) for task in work)
            try:
                with closing(results):
                    for task, result in results:
                        self._insert(task, result)
                        finished += task.frames
                        self.progress("tracking again" if task.use_memory else "tracking", finished, total)
            except VideoError:
                if self.frames.is_exact:
                    raise
                self.scan(exact=True)

    def missing(self) -> list[Task]:
        """The missing passes, longest first: for each stretch passes without a memory, then passes with one.

        A pass without a memory is not missing if a longer one from the same keyframe contains it. Passes with a memory
        are missing if there are unchecked frames, and other boxes of the object.
        """
        tasks: list[Task] = []
        for stretch in self._stretches():
            plain = self._missing_of(stretch, use_memory=False)
            several = len(self._drawn[stretch.object]) > 1
            again = several and not plain and not self._is_checked(stretch)
            tasks += self._missing_of(stretch, use_memory=True) if again else plain
        return sorted(tasks, key=lambda task: -task.frames)

    def submit(self, task: Task) -> tuple[Future[tuple[Task, Pass | None]], Path]:
        """Run a missing pass in one of the processes; `store` receives the future.

        The size of the file is the number of tracked frames. Deleting the file stops the pass.
        """
        file, count = tempfile.mkstemp(dir=self._folder.name)
        os.close(file)
        work = task, self.frames, self.settings, Path(self._folder.name), Path(count)
        return self._workers.submit(_work, *work), Path(count)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Pause the submitted passes inside a `with`, to free the processor; each pauses after its current frame."""
        file = Path(self._folder.name, PAUSED)
        file.touch()
        try:
            yield
        finally:
            file.unlink(missing_ok=True)  # several threads may pause passes

    def store(self, future: Future[tuple[Task, Pass | None]]) -> None:
        """Store a submitted pass, which is used as long as its boxes exist.

        VideoError if a frame could not be decoded.
        """
        self._insert(*self._workers.result(future))

    def save_passes(self) -> None:
        """Write the passes of existing boxes to the file `stored`; VideoError if it cannot be written."""
        if self.stored is not None:
            boxes = [drawn.items() for drawn in self._drawn.values()]
            tasks = [task for task in self._passes if any(set(task.keyframes) <= drawn for drawn in boxes)]
            tasks = [task for task in tasks if self._passes[task] is not None]
            arrays = {
                f"{name}{number}": getattr(self._passes[task], name)
                for number, task in enumerate(tasks)
                for name in ("boxes", "scores")
            }
            with writing(self.stored, VideoError):
                facts = {"origin": self._origin(), "tasks": msgspec.to_builtins(tasks)}
                storage.write(self.stored, arrays, facts, durable=False)

    def _load_passes(self) -> None:
        """Read the file `stored`, unless it is damaged, or from other frames, settings or another version."""
        with suppress(OSError, ProtocolError):
            arrays, facts = storage.read(self.stored or os.devnull)
            tasks = msgspec.convert(facts["tasks"], list[Task]) if facts["origin"] == self._origin() else []
            for number, task in enumerate(tasks):
                rows = arrays[f"boxes{number}"], arrays[f"scores{number}"]
                self._insert(task, Pass(task.start, task.stop, *rows, task.use_memory))

    def _origin(self) -> list[object]:
        """The inputs of the passes except the boxes; stored passes are used only if they are equal."""
        stats = [file.stat() for file in self.frames.images or [self._video] if file.exists()]  # or a pattern
        files = [[stat.st_size, stat.st_mtime_ns] for stat in stats]
        return [version("catstream"), self.settings.changed(), repr(self._part), len(self.frames), files]

    @property
    def tracks(self) -> dict[str, ObjectTracks]:
        """The track of each object in all frames, by name, with `checked` and `probability`."""
        return {name: self._tracks(name) for name in self.keyframes}

    @property
    def checked(self) -> dict[str, list[Check]]:
        """The check of each frame (keyframe, hidden, checked or unchecked), by the name of the object."""
        return {name: [*map(tracks.check, range(len(tracks)))] for name, tracks in self.tracks.items()}

    @property
    def share_checked(self) -> float:
        """Share of frames over all objects that are not unchecked, from 0 to 1."""
        unchecked = [tracks.unchecked for tracks in self.tracks.values()]
        return 1 - float(np.mean(unchecked)) if unchecked else 0.0

    def passes(self, name: str = UNNAMED) -> list[Pass]:
        """The finished passes of an object, in the order of their keyframes: the proposals for its unchecked frames."""
        drawn = self._drawn.get(name, {}).items()
        passes = [item for task, item in self._passes.items() if item is not None and set(task.keyframes) <= drawn]
        return sorted(passes, key=lambda item: (item.start, item.stop, item.with_memory))

    def proposals(self, name: str, frame: int) -> dict[bool, Box | None]:
        """The box of the pass with the highest score at a frame, for each direction with a pass: True is forwards."""
        boxes: dict[bool, Box | None] = {}
        for stretch in self._stretches():
            if stretch.object == name and stretch.start <= frame < stretch.stop:
                candidates = [(part, abs(frame - part.start) - 1) for part in self._parts(stretch)]
                for part, row in sorted(candidates, key=lambda item: item[0].scores[item[1]]):  # best last
                    boxes[part.is_forward] = box_of(part.boxes[row])
        return boxes

    def next_frame(self) -> NextFrame | None:
        """The first of `next_frames`; None if all frames are checked."""
        return next(iter(self.next_frames()), None)

    def next_frames(self) -> list[NextFrame]:
        """A frame to annotate in each unchecked stretch, most expected errors first.

        The frame halves the expected errors of its stretch or, with hidden frames, of the part between them with the
        most errors. At an end of the video without a keyframe, it is the first or the last frame.
        """
        unchecked = (stretch for stretch in self._stretches() if not self._is_checked(stretch))
        return sorted(map(self._next_in, unchecked), key=lambda frame: -frame.errors)

    def _check(self, keyframes: Mapping[str, Mapping[int, KeyframeBox]]) -> None:
        """Raise BoxError if a box is outside its frame or, once the video is scanned, a keyframe outside the video."""
        for name, drawn in keyframes.items():
            for frame, box in drawn.items():
                with errors_about(name):
                    if self._is_scanned and not 0 <= frame < len(self.frames):
                        raise BoxError(
                            f"frame {frame} is outside the video: pass a frame from 0 to {len(self.frames) - 1}"
                        )
                    if isinstance(box, Box):
                        box.validated(*self.frames.size)

    def _stretches(self) -> Iterator[_Stretch]:
        """Yield the non-empty stretches of all objects."""
        for name, drawn in self._drawn.items():
            ends = [-1, *sorted(drawn), len(self.frames)]
            for before, after in pairwise(ends):
                if after - before > 1:
                    yield _Stretch(name, before + 1, after)

    def _routes(self, stretch: _Stretch) -> list[tuple[int, int]]:
        """Start and stop of the passes of a stretch: one from each end that is a keyframe."""
        drawn, before, after = self._drawn[stretch.object], stretch.start - 1, stretch.stop
        routes = [(before, min(after, len(self.frames) - 1)), (after, max(before, 0))]
        return [route for route in routes if route[0] in drawn]

    def _missing_of(self, stretch: _Stretch, *, use_memory: bool) -> list[Task]:
        name, drawn = stretch.object, self._drawn[stretch.object]
        tasks = []
        for start, stop in self._routes(stretch):
            boxes = tuple(sorted(drawn.items())) if use_memory else ((start, drawn[start]),)
            task = Task(name, start, stop, boxes, use_memory)
            same = (item for item in self.passes(name) if item.start == start and item.with_memory == use_memory)
            done = any(item.stop == stop or (item.covers(start, stop) and not use_memory) for item in same)
            if not done and task not in self._passes and (use_memory or drawn[start] is not None):
                tasks.append(task)
        return tasks

    def _tracks(self, name: str) -> ObjectTracks:
        drawn, count = self._drawn[name], len(self.frames)
        boxes, probabilities, scores = np.full((count, 4), np.nan), np.ones(count), np.ones(count)
        for frame, box in drawn.items():
            boxes[frame] = row_of(box)
        for stretch in self._stretches():
            if stretch.object == name:
                part = slice(stretch.start, stretch.stop)
                boxes[part], probabilities[part], scores[part] = self._fused(stretch)
        return ObjectTracks(name, self.keyframes[name], self.frames.times, boxes, probabilities, scores)

    def _parts(self, stretch: _Stretch) -> list[Pass]:
        """The parts of the finished passes in a stretch."""
        drawn = self._drawn[stretch.object]
        parts = (item.part(*route, drawn) for route in self._routes(stretch) for item in self.passes(stretch.object))
        return [part for part in parts if part is not None]

    def _fused(self, stretch: _Stretch) -> tuple[Float64, Float64, Float64]:
        if stretch not in self._fusions:
            fused = fuse(self._parts(stretch), stretch.start, stretch.stop, self._drawn[stretch.object])
            self._fusions[stretch] = fused
        return self._fusions[stretch]

    def _insert(self, task: Task, result: Pass | None) -> None:
        self._passes[task] = result
        first, last = sorted((task.start, task.stop))
        for stretch in [*self._fusions]:
            if stretch.start <= last and first < stretch.stop:
                del self._fusions[stretch]

    def _hidden(self, stretch: _Stretch) -> list[int]:
        """The frames of a stretch where the object is hidden, relative to its start."""
        hidden = self.keyframes[stretch.object].keys() - self._drawn[stretch.object].keys()
        return sorted(frame - stretch.start for frame in hidden if stretch.start <= frame < stretch.stop)

    def _is_checked(self, stretch: _Stretch) -> bool:
        unchecked = self._fused(stretch)[1] < CHECKED
        unchecked[self._hidden(stretch)] = False
        return not unchecked.any()

    def _next_in(self, stretch: _Stretch) -> NextFrame:
        errors, hidden = 1 - self._fused(stretch)[1], self._hidden(stretch)
        errors[hidden] = 0.0
        answers, last = self.keyframes[stretch.object], len(self.frames) - 1
        if stretch.start == 0 and 0 not in answers:
            frame = 0
        elif stretch.stop == last + 1 and last not in answers:
            frame = last
        else:
            parts = np.split(np.arange(len(errors)), hidden)
            part = max(parts, key=lambda part: errors[part].sum())
            middle = np.searchsorted(errors[part].cumsum(), errors[part].sum() / 2)
            frame = stretch.start + int(part[middle])
        return NextFrame(frame, stretch.object, float(errors.sum()))


def annotate(
    video: str | os.PathLike[str],
    boxes: KeyframeBoxes,
    settings: Settings | Mapping[str, object] | None = None,
    *,
    part: slice = ALL_FRAMES,
    jobs: int | None = None,
    progress: Progress = lambda *_: None,
) -> Annotation:
    """Track objects between boxes at keyframes of a video, and check the tracks.

    Each stretch between two boxes is tracked from both ends. A frame is checked if the passes agree so well that its
    box is correct with a probability of 97 %, see `catstream.offline.fusion`. See `Annotation` for the parameters and
    errors.
    """
    if not boxes:
        raise ObjectError("no object: pass the box of one in at least one frame")
    annotation = Annotation(video, boxes, settings, part=part, jobs=jobs, progress=progress)
    try:
        annotation.track()
    except BaseException:
        annotation.close()
        raise
    return annotation


def _work(
    task: Task, frames: VideoFrames, settings: Settings, models: Path, count: Path | None = None
) -> tuple[Task, Pass | None]:
    route = task.start, task.stop, dict(task.keyframes)
    try:
        return task, run_pass(frames, *route, settings, models, use_memory=task.use_memory, count=count)
    finally:
        frames.close()


def _parsed(boxes: KeyframeBoxes) -> dict[str, dict[int, KeyframeBox]]:
    """The boxes by object and frame; ObjectError if an object has no box, or a name is invalid."""
    if all(isinstance(value, Mapping) for value in boxes.values()):
        by_name = cast(Mapping[str, _BoxesByFrame], boxes)
    else:
        by_name = {UNNAMED: cast(_BoxesByFrame, boxes)}
    parsed: dict[str, dict[int, KeyframeBox]] = {}
    for name, drawn in by_name.items():
        with errors_about(check_name(name)):
            parsed[name] = {int(frame): box if box is None else parse_box(box) for frame, box in drawn.items()}
        if not any(isinstance(box, Box) for box in parsed[name].values()):
            raise ObjectError(f"{listed([name])} has no box: pass its box in at least one frame")
    return parsed
