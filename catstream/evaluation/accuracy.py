"""The accuracy of trackers from their runs: a row for each sequence and tracker, means, JSON, and a report in HTML."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, pstdev

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.settings import Settings
from catstream.errors import CatstreamError
from catstream.evaluation.runs import EvaluationRun
from catstream.evaluation.scores import OVERLAPS, PIXELS, precision_plot, success_plot
from catstream.reports.provenance import provenance
from catstream.reports.report import Plot, write_page

#: The measures of a row that are averaged, with their headings.
MEASURES = {
    "auc": "AUC",
    "success": "success",
    "precision": "precision",
    "normalised_precision": "norm. precision",
    "f_score": "F",
    "fps": "frames/s",
}

#: The counts of a row, which are added up: see `scores.Absence`.
COUNTS = ("absent", "noticed", "present", "false")

#: The headings of `cells`.
HEADINGS = (*list(MEASURES.values())[:-1], "absence noticed", "falsely absent", MEASURES["fps"])

#: Difference of the smallest and the largest success over several initial boxes, above which a sequence flips.
FLIP = 0.25


@dataclass(frozen=True, slots=True)
class Row:
    """The measures of one tracker on one sequence: means over its runs.

    `auc`, `success` (overlap above 0.5), `precision` (20 pixels) and `normalised_precision` are those of `scores.py`,
    from 0 to 1. `lost` is the share of the runs that have lost the object in the end. `f_score` and its two components
    are None if the object is never absent. `noticed` of the `absent` frames without the object, and `false` of the
    `present` ones with it, have no reported box: these are counts over all runs. The spreads are standard deviations
    over the runs. `flips` is None unless the runs have different initial boxes; it is true if their smallest and
    largest success differ by more than 0.25: then chance decides.
    """

    name: str
    tracker: str
    frames: int
    runs: int
    auc: float
    auc_spread: float
    success: float
    success_spread: float
    precision: float
    normalised_precision: float
    lost: float
    f_score: float | None
    long_term_precision: float | None
    long_term_recall: float | None
    flips: bool | None
    fps: float
    absent: int
    noticed: int
    present: int
    false: int


def rows_of(runs: Iterable[EvaluationRun]) -> list[Row]:
    """Return a row for each sequence and tracker, in order of first occurrence."""
    groups: dict[tuple[str, str], list[EvaluationRun]] = {}
    for run in runs:
        groups.setdefault((run.sequence.name, run.tracker), []).append(run)
    return [_row(name, tracker, group) for (name, tracker), group in groups.items()]


def mean_of(rows: Iterable[Row]) -> dict[str, dict[str, float | None]]:
    """Return the mean of each measure over the sequences, and the sum of each count, by tracker.

    The mean of the F-score is over the sequences that have one.
    """
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.tracker, []).append(row)
    return {
        tracker: {measure: _mean(getattr(row, measure) for row in group) for measure in MEASURES}
        | {count: sum(getattr(row, count) for row in group) for count in COUNTS}
        for tracker, group in groups.items()
    }


def cells(measured: Row | Mapping[str, float | None]) -> list[str]:
    """Return the measures of a row or a mean as text, in the order of `HEADINGS`; with the spread of several runs."""
    values = dataclasses.asdict(measured) if isinstance(measured, Row) else measured

    def text(measure: str) -> str:
        value, spread = values[measure], values.get(f"{measure}_spread")
        if value is None:
            return "-"
        return f"{value:.3f}" if spread is None or values.get("runs") == 1 else f"{value:.3f} ±{spread:.3f}"

    def share(part: float | None, whole: float | None) -> str:
        if part is None or not whole:
            return "-"
        return f"{part}/{whole} {part / whole:.{0 if part / whole > 0.1 else 1}%}"

    measures = [text(measure) for measure in MEASURES if measure != "fps"]
    shares = share(values["noticed"], values["absent"]), share(values["false"], values["present"])
    return [*measures, *shares, f"{values['fps']:.0f}"]


def by_attribute(rows: Iterable[Row], attributes: Mapping[str, Iterable[str]]) -> dict[str, list[Row]]:
    """Return the rows of the sequences with each attribute; `attributes` are those of each sequence, by its name."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        for attribute in dict.fromkeys(attributes.get(row.name, ())):
            groups.setdefault(attribute, []).append(row)
    return dict(sorted(groups.items()))


def flips_of(rows: Iterable[Row]) -> dict[str, list[str]]:
    """Return the names of the sequences that flip, by tracker, if its runs have different initial boxes."""
    names: dict[str, list[str]] = {}
    for row in rows:
        if row.flips is not None:
            names.setdefault(row.tracker, []).extend([row.name] if row.flips else [])
    return names


def describe_flips(rows: Iterable[Row]) -> list[str]:
    """Return the number and the names of the sequences that flip, a sentence for each tracker as in `flips_of`."""
    rows = list(rows)
    count = len({row.name for row in rows})
    return [
        f"{tracker}: {len(names)} of {count} sequences flip with the initial box (success differs by more than {FLIP})"
        + (f": {', '.join(names)}" if names else "")
        for tracker, names in flips_of(rows).items()
    ]


def to_json(rows: list[Row], settings: Settings, attributes: Mapping[str, Iterable[str]]) -> dict[str, object]:
    """Return the JSON of `catstream evaluate --json`: rows, means, flips and attributes, and provenance."""
    return {
        **provenance(settings),
        "sequences": [dataclasses.asdict(row) for row in rows],
        "mean": mean_of(rows),
        "flips": flips_of(rows),
        "attributes": {
            attribute: {"sequences": list(dict.fromkeys(row.name for row in group)), "mean": mean_of(group)}
            for attribute, group in by_attribute(rows, attributes).items()
        },
    }


def _row(name: str, tracker: str, runs: list[EvaluationRun]) -> Row:
    scores = [run.score() for run in runs]
    success = [score.success for score in scores]
    long = [score.long_term for score in scores if score.long_term is not None]
    counts = {count: sum(getattr(score.absence, count) for score in scores) for count in COUNTS}
    return Row(
        name=name,
        tracker=tracker,
        frames=len(runs[0].sequence),
        runs=len(runs),
        auc=fmean(score.auc for score in scores),
        auc_spread=pstdev(score.auc for score in scores),
        success=fmean(success),
        success_spread=pstdev(success),
        precision=fmean(score.precision for score in scores),
        normalised_precision=fmean(score.normalised_precision for score in scores),
        lost=fmean(score.lost for score in scores),
        f_score=_mean(part.f_score for part in long),
        long_term_precision=_mean(part.precision for part in long),
        long_term_recall=_mean(part.recall for part in long),
        flips=max(success) - min(success) > FLIP if any(run.start.variation.name for run in runs) else None,
        fps=fmean(run.fps for run in runs),
        **counts,
    )


def _mean(values: Iterable[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return fmean(numbers) if numbers else None


def write_report(
    path: Path,
    runs: list[EvaluationRun],
    settings: Settings,
    attributes: Mapping[str, Iterable[str]],
    errors: Sequence[CatstreamError] = (),
) -> Path:
    """Write the report of an evaluation as one self-contained HTML file.

    attributes : those of each sequence, by its name
    errors : those of runs that are not included
    """
    rows = rows_of(runs)
    means = mean_of(rows)
    frames = {row.name: row.frames for row in rows}
    return write_page(
        path,
        "evaluation.html",
        sequences=len(frames),
        frames=sum(frames.values()),
        runs=len(runs),
        errors=errors,
        flips=describe_flips(rows),
        plots=_plots(runs, sorted(means, key=lambda tracker: -(means[tracker]["auc"] or 0.0))),
        headings=[*HEADINGS],
        rows=[[row.name, row.tracker, row.frames, *cells(row)] for row in rows]
        + [["mean", tracker, "", *cells(mean)] for tracker, mean in means.items()],
        means=len(means),
        attributes=[
            [attribute, tracker, len({row.name for row in group}), *cells(mean)]
            for attribute, group in by_attribute(rows, attributes).items()
            for tracker, mean in mean_of(group).items()
        ],
        settings=settings,
    )


def _plots(runs: list[EvaluationRun], trackers: list[str]) -> Iterator[Plot]:
    """Plot success and precision of each tracker, averaged over the starts of a sequence, then over the sequences."""

    def curve(tracker: str, measure: Callable[..., Float64]) -> Float64:
        by_sequence: dict[str, list[Float64]] = {}
        for run in runs:
            if run.tracker == tracker:
                by_sequence.setdefault(run.sequence.name, []).append(measure(run.boxes, run.truth))
        mean: Float64 = np.mean([np.mean(curves, axis=0) for curves in by_sequence.values()], axis=0)
        return mean

    success = {tracker: curve(tracker, success_plot) for tracker in trackers}
    precision = {tracker: curve(tracker, precision_plot) for tracker in trackers}
    yield Plot.of(
        "Success (AUC)",
        "overlap threshold",
        OVERLAPS,
        {f"{tracker} {shares.mean():.3f}": shares for tracker, shares in success.items()},
    )
    yield Plot.of(
        "Precision (at 20 pixels)",
        "distance in pixels",
        PIXELS,
        {f"{tracker} {shares[20]:.3f}": shares for tracker, shares in precision.items()},
    )
