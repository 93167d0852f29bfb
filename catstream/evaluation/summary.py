"""Summaries of runs: a row for each sequence and tracker, the mean of each tracker, and both as JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import fmean, pstdev

from catstream.evaluation.provenance import provenance
from catstream.evaluation.runs import EvaluationRun
from catstream.settings import Settings

__all__ = ["MEASURES", "Row", "mean_of", "rows_of", "to_json"]

#: The measures of a row that are averaged.
MEASURES = ("auc", "success", "precision", "normalised_precision", "f_score", "fps")


@dataclass(frozen=True, slots=True)
class Row:
    """The measures of one tracker on one sequence: means over its starts.

    `auc`, `success` (overlap above 0.5), `precision` (20 pixels) and `normalised_precision` are those of
    `catstream.evaluation.metrics`, from 0 to 1. `f_score` and its two components are None if the object is never
    absent. The spreads are standard deviations over the starts.
    """

    name: str
    tracker: str
    frames: int
    starts: int
    auc: float
    auc_spread: float
    success: float
    success_spread: float
    precision: float
    normalised_precision: float
    f_score: float | None
    long_term_precision: float | None
    long_term_recall: float | None
    fps: float


def rows_of(runs: Iterable[EvaluationRun]) -> list[Row]:
    """Return a row for each sequence and tracker, in order of first occurrence."""
    groups: dict[tuple[str, str], list[EvaluationRun]] = {}
    for run in runs:
        groups.setdefault((run.sequence.name, run.tracker), []).append(run)
    return [_row(name, tracker, group) for (name, tracker), group in groups.items()]


def mean_of(rows: Iterable[Row]) -> dict[str, dict[str, float | None]]:
    """Return the mean of each measure over the sequences, by tracker; that of the F-score over those that have one."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.tracker, []).append(row)
    return {
        tracker: {measure: _mean(getattr(row, measure) for row in group) for measure in MEASURES}
        for tracker, group in groups.items()
    }


def to_json(rows: list[Row], settings: Settings) -> dict[str, object]:
    """Return the JSON of `catstream evaluate --json`: rows, {tracker: {measure: mean}}, and provenance."""
    return {**provenance(settings), "sequences": [dataclasses.asdict(row) for row in rows], "mean": mean_of(rows)}


def _row(name: str, tracker: str, runs: list[EvaluationRun]) -> Row:
    scores = [run.score() for run in runs]
    long = [score.long_term for score in scores if score.long_term is not None]
    return Row(
        name=name,
        tracker=tracker,
        frames=len(runs[0].sequence),
        starts=len(runs),
        auc=fmean(score.auc for score in scores),
        auc_spread=pstdev(score.auc for score in scores),
        success=fmean(score.success for score in scores),
        success_spread=pstdev(score.success for score in scores),
        precision=fmean(score.precision for score in scores),
        normalised_precision=fmean(score.normalised_precision for score in scores),
        f_score=_mean(part.f_score for part in long),
        long_term_precision=_mean(part.precision for part in long),
        long_term_recall=_mean(part.recall for part in long),
        fps=fmean(run.fps for run in runs),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
