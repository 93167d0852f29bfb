"""An annotation that a person changes while its passes run: what the page of `catstream annotate` shows."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Self

from catstream.base.arrays import UInt8
from catstream.base.box import Box
from catstream.base.system import release_memory
from catstream.errors import CatstreamError, CommandRejectedError, ObjectError, VideoError
from catstream.offline.annotation import Annotation, NextFrame, Task
from catstream.offline.keyframes import KeyframeBox
from catstream.offline.object_tracks import ObjectTracks

#: Passes of more frames leave one process to shorter ones, so that a correction of a short stretch does not wait.
_LONG = 600

#: Expected errors of a stretch from which a box is asked for while others are tracked.
_WORTHWHILE = 3.0


class _StoppedError(Exception):
    pass


class Session:
    """Changes the boxes of an annotation, while a thread reads the video and runs the missing passes.

    The passes of the objects run in rotation, beginning with the object of the newest box, whose passes run first. The
    methods may be called from any thread. Use it in a `with`, also more than once: it continues where it was. The
    caller closes the annotation afterwards.

    Parameters
    ----------
    annotation : Annotation whose frames are not numbered yet
    jobs : number of long passes that run at a time, and of all passes less one
    save : function that is called after each change of the keyframes
    write : function that writes the results; called by `finish`
    """

    def __init__(
        self, annotation: Annotation, jobs: int, save: Callable[[], object], write: Callable[[], object]
    ) -> None:
        self.annotation = annotation
        self.write = write
        self._jobs = jobs
        self._save = save
        self.revision = 0  #: number of changes of the keyframes and of what follows
        self.decoded = False  #: whether the frames of the video are numbered
        self.tracks: dict[str, ObjectTracks] = {}  #: the newest tracks, by the name of the object
        self.next_frames: list[NextFrame] = []  #: to look at next, outside the stretches that are being tracked
        self.problem: CatstreamError | None = None  #: error that ended reading or tracking
        self.finished = threading.Event()  #: set by `finish`
        self.lock = threading.Condition(threading.RLock())  #: acquired while the annotation changes
        self._history: list[tuple[str, int | None, dict[str, dict[int, KeyframeBox]]]] = []  # with the boxes before
        self._newest: dict[str, int] = {}  # frame of the newest box of each object
        self._last: dict[str, int] = {}  # number of the newest pass of each object; one without a pass is next
        self._missing: list[Task] = []
        self._running: dict[Future[Any], tuple[Task, Path]] = {}  # with the file that counts its frames
        self._wakes = True  # whether the missing passes have to be determined
        self._is_damaged = False  # whether a frame could not be decoded, so that all have to be read again
        self._closed = False
        annotation.progress = self._check_closed
        annotation.frames.is_threaded = True  # for the pictures of the page

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._wake()
        self._thread.join()
        self.annotation.stop()
        self._running.clear()
        self._closed, self._wakes = False, True

    @property
    def can_undo(self) -> bool:
        return bool(self._history)

    def draw(self, object: str, frame: int, box: KeyframeBox) -> None:
        """Add or replace the box of an object at a frame; errors as of `Annotation`."""
        with self.lock:
            before = self.annotation.keyframes
            self._newest[object] = frame
            self._last.pop(object, None)
            self._change({**before, object: {**before.get(object, {}), frame: box}}, object, frame)

    def delete(self, object: str, frame: int | None = None) -> None:
        """Delete the box of an object at a frame; without a frame, or with its last box, delete the object."""
        with self.lock:
            before = self.annotation.keyframes
            boxes = {number: box for number, box in before.get(object, {}).items() if frame not in (None, number)}
            after = {name: boxes if name == object else drawn for name, drawn in before.items()}
            if not any(isinstance(box, Box) for box in boxes.values()):
                after.pop(object, None)
            if after != before:
                self._change(after, object, frame)

    def rename(self, object: str, name: str) -> None:
        """Rename an object, which keeps its passes; ObjectError if there is another object with this name."""
        with self.lock:
            before = self.annotation.keyframes
            if name == object:
                return
            if name in before:
                raise ObjectError(f"there is an object {name} already: use another name")
            self._change({name if other == object else other: drawn for other, drawn in before.items()}, object, None)

    def undo(self) -> tuple[str, int | None] | None:
        """Undo the last change; return its object, and the frame of its box. None if there is none."""
        with self.lock:
            if not self._history:
                return None
            object, frame, before = self._history.pop()
            self._replace(before)
            return object, frame

    def image(self, number: int) -> UInt8:
        """Return the image of a frame; passes are paused meanwhile. VideoError if it cannot be decoded: then, all
        frames are read again to find the damage."""
        try:
            with self.annotation.paused():
                return self.annotation.frames[number]
        except VideoError:
            with self.lock:
                self._is_damaged = not self.annotation.frames.is_exact
                self._wake()
            raise

    def finish(self) -> None:
        """Write the results so far, and set `finished`. VideoError if they cannot be written."""
        with self.lock:
            if not self.decoded:
                raise VideoError("the video is not read yet: wait, or press Ctrl-C where the command runs")
            self.write()
            self.finished.set()

    def remaining(self) -> int:
        """Number of frames that passes have to track, in both directions; 1 until those after a change are counted."""
        with self.lock:
            tracked = {task: count.stat().st_size for task, count in self._running.values()}
            return max(int(self._wakes), sum(max(1, task.frames - tracked.get(task, 0)) for task in self._missing))

    def _change(self, keyframes: dict[str, dict[int, KeyframeBox]], object: str, frame: int | None) -> None:
        """Replace the boxes, which `undo` brings back."""
        before = self.annotation.keyframes
        self._replace(keyframes)
        self._history.append((object, frame, before))

    def _replace(self, keyframes: dict[str, dict[int, KeyframeBox]]) -> None:
        if self.finished.is_set():
            raise CommandRejectedError("the results are written: run the same command to continue")
        before = self.annotation.keyframes
        self.annotation.set_boxes(keyframes)
        try:
            self._save()
        except BaseException:
            self.annotation.set_boxes(before)
            raise
        self._wake()

    def _wake(self) -> None:
        with self.lock:
            self.revision += 1
            self._wakes = True
            self.lock.notify()

    def _check_closed(self, *_: object) -> None:
        if self._closed:
            raise _StoppedError

    def _run(self) -> None:
        try:
            self._scan()
            while True:
                with self.lock:
                    self.lock.wait_for(lambda: self._wakes or self._closed)
                    if self._closed:
                        return
                    self._wakes = False
                    if not self._is_damaged:
                        self._schedule()
                if self._is_damaged:
                    self._scan(exact=True)
        except CatstreamError as error:
            self.problem = error
        except _StoppedError:  # while it reads
            pass

    def _scan(self, *, exact: bool = False) -> None:
        """Number the frames: before the first damaged one, they can be annotated."""
        self.decoded = self._is_damaged = False
        for running in [*self._running]:
            self._stop(running)
        try:
            self.annotation.scan(exact=exact)
        except VideoError as error:
            self.problem = error
        self.annotation.scan()
        release_memory()
        self.decoded = True
        self._wake()

    def _schedule(self) -> None:
        """Store the passes that ended, stop those that are not missing any more, and start others."""
        for future in [future for future in self._running if future.done()]:
            del self._running[future]
            try:
                self.annotation.store(future)
            except VideoError:
                if self.annotation.frames.is_exact:
                    raise
                self._is_damaged = True
                return
        self._missing = self.annotation.missing()
        for future, (task, _) in [*self._running.items()]:
            if task not in self._missing:
                self._stop(future)
        while following := self._next_task():
            self._last[following.object] = max(self._last.values(), default=0) + 1
            future, count = self.annotation.submit(following)
            self._running[future] = following, count
            future.add_done_callback(lambda _: self._wake())
        self.tracks = self.annotation.tracks
        least = _WORTHWHILE if self._missing else 0.0
        frames = (frame for frame in self.annotation.next_frames() if frame.errors >= least)
        self.next_frames = [frame for frame in frames if not self._is_tracked(frame)]
        self.revision += 1

    def _stop(self, future: Future[Any]) -> None:
        _, count = self._running.pop(future)
        count.unlink()  # ends it

    def _next_task(self) -> Task | None:
        """The missing pass that starts next: the shortest at the newest box of the object that has waited longest."""

        def order(task: Task) -> tuple[int, bool, int]:
            is_newest = self._newest.get(task.object) in (task.start, task.stop)
            return self._last.get(task.object, 0), not is_newest, task.frames

        running = [task for task, _ in self._running.values()]
        limit = _LONG if sum(task.frames > _LONG for task in running) >= self._jobs else sys.maxsize
        waiting = [task for task in self._missing if task not in running and task.frames <= limit]
        return min(waiting, key=order) if waiting and len(running) <= self._jobs else None

    def _is_tracked(self, following: NextFrame) -> bool:
        """Return True if a missing pass may check the frame soon: none can at an end of the video without a box."""
        frame, ends = following.frame, (0, len(self.annotation.frames) - 1)
        return frame not in ends and any(
            task.object == following.object and min(task.start, task.stop) <= frame <= max(task.start, task.stop)
            for task in self._missing
            if not (task.use_memory and task.frames > _LONG)  # a person need not wait for it to add a box
        )


class Sessions:
    """Sessions of several videos, of which one is open: its passes run. Use it in a `with`.

    The others keep their boxes, finished passes and changes to undo.

    Parameters
    ----------
    names : names of the videos
    start : function that returns the session of a video by its number; VideoError if it cannot be read
    shares : share of checked frames of each video so far, from 0 to 1
    """

    def __init__(self, names: Sequence[str], start: Callable[[int], Session], shares: Sequence[float]) -> None:
        self.names = names
        self.shares = [*shares]
        self.number = 0  #: of the open video
        self.opened: dict[int, Session] = {}  #: by the number of the video
        self._start = start
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        self.opened[0] = self._start(0).__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.current.__exit__()
        for session in self.opened.values():
            session.annotation.close()

    @property
    def current(self) -> Session:
        """The session of the open video."""
        return self.opened[self.number]

    def open(self, number: int) -> None:
        """Open another video, and write the results of the previous one; VideoError if either fails."""
        with self._lock:
            before = self.current
            if number == self.number or before.finished.is_set():
                return
            session = self.opened.get(number) or self._start(number)
            before.__exit__()
            try:
                if before.decoded and (before.annotation.keyframes or before.can_undo):
                    self.shares[self.number] = before.annotation.share_checked
                    before.write()
            finally:
                session.revision += before.revision + 1  # it never decreases for the page
                self.opened[number] = session.__enter__()
                self.number = number
