"""One-pass evaluation: a tracker runs once over each sequence, from its initial box, without reinitialisation."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Protocol

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.base.workers import run_tasks
from catstream.errors import CatstreamError, VideoError
from catstream.measure.datasets import Sequence
from catstream.measure.scores import Score, score
from catstream.tracker import Tracker


class SingleTracker(Protocol):
    """The interface of a tracker of one object, as in OpenCV and `catstream.Tracker`."""

    def init(self, frame: np.ndarray, box: Box, /) -> Any: ...

    def update(self, frame: np.ndarray, /) -> tuple[bool, Box | None]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """The output of a tracker on a sequence, from the first frame with the object on.

    sequence  sequence from this frame on
    boxes     float64 (frames, 4), beginning with the initial box; NaN if the tracker reported no box
    seconds   float64 (frames,), processing time of the tracker, without decoding
    """

    sequence: Sequence
    boxes: Float64
    seconds: Float64

    @property
    def fps(self) -> float:
        """Frames per second without the first frame, which initialises the tracker."""
        return (len(self.seconds) - 1) / max(float(self.seconds[1:].sum()), 1e-9)

    def score(self) -> Score:
        return score(self.boxes, self.sequence.boxes)


def follow(sequence: Sequence, tracker: SingleTracker, box: Box | None = None) -> Run:
    """Run a tracker on a sequence from an initial box, by default the ground truth."""
    box = box or Box(*map(float, sequence.boxes[0]))
    boxes, seconds = np.full((len(sequence), 4), np.nan), np.zeros(len(sequence))
    for row, image in enumerate(sequence.frames()):
        begin = perf_counter()
        if row == 0:
            tracker.init(image, box)
            output: Box | None = box
        else:
            _, output = tracker.update(image)
        seconds[row] = perf_counter() - begin
        if output is not None:
            boxes[row] = output
    return Run(sequence, boxes.round(4), seconds)  # the precision of the toolkits' files


def evaluate(
    sequences: list[Sequence],
    settings: Settings,
    *,
    jobs: int = 1,
    done: Callable[[Run], None] = lambda _: None,
    failed: Callable[[CatstreamError], None] | None = None,
) -> list[Run]:
    """Run `catstream.Tracker` on sequences, and return the runs in order.

    jobs : number of processes, with one thread each
    done : function that is called with each finished run
    failed : function that is called with the error of each failed run; if None, the error is raised
    """
    names = [sequence.name for sequence in sequences]
    for name in names:
        if names.count(name) > 1:
            raise VideoError(f"duplicate sequence name {name!r}: rename one of the folders")
    runs: dict[str, Run] = {}
    tasks = [(sequence, settings) for sequence in sorted(sequences, key=len, reverse=True)]  # longest first
    results = run_tasks(_follow, tasks, jobs) if jobs > 1 else (_follow(*task) for task in tasks)
    with closing(results):  # an error or Ctrl-C kills the workers
        for result in results:
            if isinstance(result, Run):
                runs[result.sequence.name] = result
                done(result)
            elif failed is None:
                raise result
            else:
                failed(result)
    return [runs[name] for name in names if name in runs]


def _follow(sequence: Sequence, settings: Settings) -> Run | CatstreamError:
    """Run catstream from the first frame with the object on, in one thread, because jobs run in parallel."""
    sequence = sequence.since(int(sequence.present.argmax()))
    try:
        with one_thread(opencv=True):
            return follow(sequence, Tracker(settings.for_length(len(sequence))))
    except CatstreamError as error:
        return CatstreamError(f"{sequence.name}: {error}")
