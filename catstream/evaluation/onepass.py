"""One-pass evaluation: each tracker runs once over each sequence, from its initial box, without reinitialisation."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.base.threads import one_thread
from catstream.base.workers import run_tasks
from catstream.errors import CatstreamError, SettingsError, VideoError
from catstream.evaluation.datasets import FIRST, Sequence, Start, Starts, one_pass
from catstream.evaluation.peers import PEERS, Peer
from catstream.evaluation.runs import EvaluationRun, load, prepare_folder, save
from catstream.tracker import Tracker

#: The trackers that can be evaluated.
TRACKERS = ("catstream", *PEERS)


class _Task(NamedTuple):
    """A run that is to be made."""

    tracker: str
    settings: Settings
    sequence: Sequence
    start: Start
    peer_models: Path | None

    @property
    def name(self) -> tuple[str, str]:
        """Names of the tracker and of the run."""
        return self.tracker, self.sequence.name + self.start.suffix

    @property
    def frames(self) -> int:
        return len(self.sequence) - self.start.frame


def follow(
    tracker: str, settings: Settings, sequence: Sequence, start: Start = FIRST, peer_models: Path | None = None
) -> EvaluationRun:
    """Run one tracker from one start to the end of a sequence, in this process."""
    frames = len(sequence) - start.frame
    worker = Tracker(settings.for_length(frames)) if tracker == "catstream" else Peer(tracker, peer_models)
    boxes, confidence, seconds = np.full((frames, 4), np.nan), np.full(frames, np.nan), np.zeros(frames)
    for row, image in enumerate(sequence.frames(start.frame)):
        initial = start.box(sequence, image.shape[1::-1]) if row == 0 else None
        begin = perf_counter()
        if initial is not None:
            worker.init(image, initial)
            box: Box | None = initial
        else:
            _, box = worker.update(image)
        seconds[row] = perf_counter() - begin
        if box is not None:
            boxes[row] = box
        confidence[row] = worker.track.score if isinstance(worker, Tracker) else worker.score
    # Rounded as in the files, so that a stored run has the same measures.
    return EvaluationRun(tracker, sequence, start, boxes.round(4), confidence.round(6), seconds.round(8))


def evaluate(
    sequences: list[Sequence],
    trackers: list[str],
    settings: Settings,
    *,
    starts: Starts = one_pass,
    peer_models: str | os.PathLike[str] | None = None,
    jobs: int = 1,
    output: str | os.PathLike[str] | None = None,
    begin: Callable[[int], None] = lambda _: None,
    done: Callable[[EvaluationRun], None] = lambda _: None,
    failed: Callable[[CatstreamError], None] | None = None,
) -> list[EvaluationRun]:
    """Run trackers, by their names in `TRACKERS`; return the runs in order of sequence, tracker and start.

    starts : the starts of a sequence, `one_pass`, or what `choose_starts` returns
    peer_models : folder of the model files of `nano`, `nano-v3` and `vit`
    jobs : number of processes, with one thread each
    output : folder for results, or None; runs that are complete there are not repeated
    begin, done : functions that are called with the total number of frames, and with each finished run
    failed : function that is called with the error of each run that fails, while the other runs continue; if None, the
        error is raised
    """
    trackers = list(dict.fromkeys(trackers))
    folder, models = (None if path is None else Path(path) for path in (output, peer_models))
    _validate_names(sequences, trackers, models)
    if folder is not None:
        prepare_folder(folder, settings)
    runs: dict[tuple[str, str], EvaluationRun] = {}

    def add(run: EvaluationRun) -> None:
        runs[run.tracker, run.name] = run
        done(run)

    tasks = [
        _Task(tracker, settings, sequence, start, models)
        for sequence in sequences
        for tracker in trackers
        for start in starts(sequence)
    ]
    begin(sum(task.frames for task in tasks))
    missing = []
    for task in tasks:
        run = None if folder is None else load(folder, task.tracker, task.sequence, task.start)
        if run is None:
            missing.append(task)
        else:
            add(run)
    with closing(_run_all(missing, folder, jobs)) as results:  # an error or Ctrl-C kills the workers
        for result in results:
            if isinstance(result, EvaluationRun):
                add(result)
            elif failed is None:
                raise result
            else:
                failed(result)
    return [runs[task.name] for task in tasks if task.name in runs]


def _run_all(tasks: list[_Task], output: Path | None, jobs: int) -> Generator[EvaluationRun | CatstreamError]:
    if jobs == 1:
        yield from (_follow_and_save(output, task) for task in tasks)
        return
    # Longest runs first, so that no single long run is left at the end.
    ranked = sorted(tasks, key=lambda task: -task.frames)
    yield from run_tasks(_follow_and_save, [(output, task) for task in ranked], jobs)


def _follow_and_save(output: Path | None, task: _Task) -> EvaluationRun | CatstreamError:
    """Run `follow` and save the run. Each tracker gets one thread: the jobs are the parallelism."""
    try:
        with one_thread(opencv=True):
            run = follow(*task)
        if output is not None:
            save(output, run)
    except CatstreamError as error:
        return CatstreamError(f"{' on '.join(task.name)}: {error}")
    return run


def _validate_names(sequences: list[Sequence], trackers: list[str], peer_models: Path | None) -> None:
    if not trackers:
        raise SettingsError(f"missing tracker: pass one of {', '.join(TRACKERS)}")
    for tracker in trackers:
        if tracker not in TRACKERS:
            raise SettingsError(f"unknown tracker {tracker!r}: pass one of {', '.join(TRACKERS)}")
        if tracker in PEERS:
            Peer(tracker, peer_models)
    names = [sequence.name for sequence in sequences]
    for name in names:
        if names.count(name) > 1:
            raise VideoError(f"duplicate sequence name {name!r}: rename one of the folders")
