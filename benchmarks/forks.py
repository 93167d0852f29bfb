"""The frames at which runs lose the object, and the state of the detector in them.

Each sequence is followed from K first boxes that differ by at most 2 %. A sequence flips if the success of these runs
differs by more than 0.25: each run that fails is compared with the best one. If all runs fail, the worst one is
compared with the ground truth. The runs are then repeated, and the state of the detector is read after each frame.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from statistics import fmean
from typing import NamedTuple

import numpy as np
from accuracy import many_sequences, videos
from table import Cell, Table, benchmark, command

from catstream.applications.evaluation.accuracy import FLIP
from catstream.applications.evaluation.datasets import jittered
from catstream.applications.evaluation.onepass import evaluate
from catstream.applications.evaluation.runs import EvaluationRun
from catstream.applications.evaluation.scores import overlaps
from catstream.box import Box
from catstream.compression.forest import Forest
from catstream.detection.detector import Detector
from catstream.detection.search import Detection
from catstream.errors import CatstreamError
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import non_maximum_suppression
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features, Level
from catstream.messages.names import UNNAMED
from catstream.settings import Settings
from catstream.training.trainer import Trainer
from catstream.video.frames import as_bgr

LOST = 0.5  #: success of the best run, below which the sequence counts as lost
APART, TOGETHER = 0.3, 5  #: overlap at most, and number of successive frames in which two runs have parted
BEFORE, AFTER = 10, 3  #: frames around a fork that are shown
STATE = ("score", "lead", "size", "aspect", "level")  #: headings for the values of `state`


class Fork(NamedTuple):
    """The frame in which a failing run leaves the good one, or the ground truth if there is no good run."""

    failing: EvaluationRun
    good: EvaluationRun | None
    frame: int


class Seen(NamedTuple):
    """One frame of a run, as the detector saw it.

    box    of the object; None if it counts as absent
    score  of the detection
    lead   difference of the highest score of the local search to the next one, more than half a window away
    level  of the belief
    rows   training rows of the group "appearance" that were taught, 0 if the frame taught nothing
    """

    box: Box | None
    score: float
    lead: float | None
    level: Level
    rows: int


def figures(options: argparse.Namespace) -> Iterator[Table]:
    sequences = videos(options)
    runs = evaluate(
        sequences,
        ["catstream"],
        Settings(),
        starts=jittered(2 if options.quick else options.jitter),
        jobs=1 if options.quick else options.jobs,
        output=options.output,
        done=lambda run: print(run.name, file=sys.stderr),
    )
    found = {one.name: [run for run in runs if run.sequence.name == one.name] for one in sequences}
    yield spreads(found)
    forks = [fork for each in found.values() for fork in forks_of(each, compare_all=options.quick)]
    frames = observed(forks)
    yield overview(forks, frames)
    yield around(forks, frames)


def success(run: EvaluationRun) -> float:
    """Return the success of a run."""
    return float(run.score().success)


def spreads(found: dict[str, list[EvaluationRun]]) -> Table:
    """Return the mean and the range of success and AUC of each sequence over its first boxes."""
    rows: list[list[Cell]] = []
    for name, runs in found.items():
        cells: list[Cell] = [name, kind(runs)]
        for values in ([success(run) for run in runs], [run.score().auc for run in runs]):
            cells += [fmean(values), min(values), max(values)]
        rows.append(cells)
    columns = ("sequence", "kind", "success", "lowest", "highest", "AUC", "lowest AUC", "highest AUC")
    flips, lost = (sum(row[1] == word for row in rows) for word in ("flips", "lost"))
    note = f"{flips} of {len(rows)} sequences flip, and {lost} are lost in all runs"
    return Table("Dependence on the first box", columns, rows, note)


def kind(runs: list[EvaluationRun]) -> str:
    """Return whether a sequence flips, or is lost in all its runs; otherwise nothing."""
    values = [success(run) for run in runs]
    if max(values) - min(values) > FLIP:
        return "flips"
    return "lost" if max(values) < LOST else ""


def forks_of(runs: list[EvaluationRun], *, compare_all: bool = False) -> Iterator[Fork]:
    """Yield a fork for each failing run of a sequence that flips, and one fork for a sequence that is lost.

    compare_all : compare the worst run with the best one, also if neither fails
    """
    best, worst = max(runs, key=success), min(runs, key=success)
    if kind(runs) == "flips":
        for run in runs:
            if success(run) < success(best) - FLIP:
                yield Fork(run, best, parting(run.boxes, best.boxes))
    elif compare_all:
        yield Fork(worst, best, parting(worst.boxes, best.boxes))
    elif kind(runs) == "lost":
        yield Fork(worst, None, parting(worst.boxes, worst.truth))


def parting(boxes: np.ndarray, others: np.ndarray) -> int:
    """Return the first of `TOGETHER` successive frames in which the boxes hardly overlap.

    If there is none, it is the frame in which they overlap least. Frames in which neither has a box do not count.
    """
    shared = overlaps(boxes, others)
    present = np.flatnonzero(np.isfinite(boxes).all(axis=1) | np.isfinite(others).all(axis=1))
    apart = np.convolve(shared[present] <= APART, np.ones(TOGETHER), "valid") == TOGETHER
    return int(present[apart.argmax()]) if apart.any() else int(present[shared[present].argmin()])


def observed(forks: list[Fork]) -> dict[str, list[Seen]]:
    """Return the first frames of each run of the forks, by name; the last one is a few frames after its last fork."""
    runs: dict[str, EvaluationRun] = {}
    last: dict[str, int] = {}
    for failing, good, frame in forks:
        for run in (failing, good or failing):
            runs[run.name] = run
            last[run.name] = max(frame + AFTER, last.get(run.name, 0))
    return {name: list(seen(run, last[name])) for name, run in runs.items()}


def seen(run: EvaluationRun, last: int) -> Iterator[Seen]:
    """Repeat a run up to a frame, and yield the state of the detector in each frame.

    Raises
    ------
    CatstreamError
        If the boxes are not those of the run.
    """
    settings = Settings().for_length(len(run.boxes))
    detector, forest, trainer = Detector(settings), Forest(settings), Trainer(settings)
    for row, image in zip(range(last + 1), run.sequence.frames(run.start.frame), strict=False):
        frame, lead = Pyramid(as_bgr(image)), None
        if row:
            found = detector.look(frame, row + 1)
            lead = lead_of(found)
            track, features = detector.settle(found, frame, row + 1, 0.0)
        else:
            track, features = detector.init(frame, 1, 0.0, run.start.box(run.sequence, frame.size))
        for sample in forest.take(Features(row + 1, row, 0.0, {UNNAMED: features})):
            detector.adopt(trainer.train(sample))
        if row and not np.array_equal(run.boxes[row], np.round(track.box or [np.nan] * 4, 4), equal_nan=True):
            raise CatstreamError(f"{run.name}, frame {row}: the run cannot be repeated; remove the folder of --output")
        level = detector.state.level if detector.state else "lost"
        rows = len(features.training[APPEARANCE]) if APPEARANCE in features.training else 0
        yield Seen(track.box, track.score, lead, level, rows)


def lead_of(found: Detection) -> float | None:
    """Return the lead of the highest peak in the score map of a detection over the second one."""
    if found.around is None:
        return None
    scores = found.around.scores
    peaks = [float(scores[place]) for place in non_maximum_suppression(scores, 2, WINDOW // 2)]
    return peaks[0] - peaks[1] if len(peaks) == 2 else None


def overview(forks: list[Fork], frames: dict[str, list[Seen]]) -> Table:
    """Return a row for each fork: its frame, the states of the failing run and of the good one, and the rows taught."""
    rows: list[list[Cell]] = []
    for failing, good, frame in forks:
        cells: list[Cell] = [failing.name, good.name if good else "ground truth", failing.start.frame + frame]
        cells += state(failing, frames, frame)
        cells += state(good, frames, frame) if good else [None] * len(STATE)
        before = range(max(frame - BEFORE, 1), frame)
        taught = [row for row in before if frames[failing.name][row].rows]
        shared = overlaps(failing.boxes, failing.truth)[taught]
        cells += [len(taught), sum(frames[failing.name][row].rows for row in taught)]
        rows.append([*cells, float(shared.mean()) if len(taught) else None])
    others = [f"its {word}" for word in STATE]
    columns = ("run", "compared with", "frame", *STATE, *others, "taught frames", "rows", "their overlap")
    note = f"""lead: over the second peak of the local search; size, aspect: as multiples of the ground truth's
taught: of the {BEFORE} frames before, with the mean overlap of the taught boxes with the ground truth"""
    return Table("Forks", columns, rows, note)


def around(forks: list[Fork], frames: dict[str, list[Seen]]) -> Table:
    """Return the frames around each fork."""
    rows: list[list[Cell]] = []
    for failing, _, frame in forks:
        shared = overlaps(failing.boxes, failing.truth)
        for row in range(max(frame - BEFORE, 0), min(frame + AFTER + 1, len(failing.boxes))):
            taught = frames[failing.name][row].rows
            rows.append(
                [failing.name, failing.start.frame + row, float(shared[row]), *state(failing, frames, row), taught]
            )
    columns = ("run", "frame", "overlap", *STATE, "rows taught")
    return Table("Frames around the forks", columns, rows, "of the failing run")


def state(run: EvaluationRun, frames: dict[str, list[Seen]], row: int) -> list[Cell]:
    """Return score, lead, size and aspect as multiples of the ground truth's, and level in a frame."""
    one, truth = frames[run.name][row], run.truth[row]
    size = aspect = None
    if one.box is not None and np.isfinite(truth).all():
        across, down = one.box.w / truth[2], one.box.h / truth[3]
        size, aspect = float(np.sqrt(across * down)), float(across / down)
    return [one.score, one.lead, size, aspect, one.level]


if __name__ == "__main__":
    benchmark(
        figures,
        many_sequences(command(__doc__)),
        jitter=(7, "number of first boxes"),
    )
