"""Writes the report of an evaluation as one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np

from catstream.applications.evaluation.failures import FailureStrip, failure_strip, worst_runs
from catstream.applications.evaluation.metrics import OVERLAPS, PIXELS, precision_plot, success_plot
from catstream.applications.evaluation.runs import EvaluationRun
from catstream.applications.evaluation.summary import (
    MEASURES,
    Row,
    by_attribute,
    cells,
    describe_flips,
    mean_of,
    rows_of,
)
from catstream.applications.html.page import figure, table, write_page
from catstream.applications.html.plots import SHARES, Axis, plot
from catstream.numerics.arrays import Float64
from catstream.settings import Settings

_STRIPS = 8  # film strips for the first tracker
_OTHER_STRIPS = 2  # and for each other tracker
_LEGEND = '<p class="about">White: ground truth. Orange: tracker.</p>'


def write_report(
    path: Path, runs: list[EvaluationRun], settings: Settings, attributes: Mapping[str, Sequence[str]]
) -> Path:
    """Write the report of an evaluation. It reads frames of the worst runs for their film strips.

    attributes : names of the sequences that have each attribute

    Raises
    ------
    ServiceError
        If the file cannot be written.
    """
    rows = rows_of(runs)
    strips: list[FailureStrip] = []
    for place, tracker in enumerate(dict.fromkeys(run.tracker for run in runs)):
        own = [run for run in runs if run.tracker == tracker]
        strips += map(failure_strip, worst_runs(own, _OTHER_STRIPS if place else _STRIPS))
    sequences, frames = len({row.name for row in rows}), sum({row.name: row.frames for row in rows}.values())
    changed = escape("\n".join(settings.changed()))
    body = [
        "<h1>Accuracy</h1>",
        f'<p class="about">{sequences} sequences, {frames:,} frames, {len(runs)} runs, one pass each. Frames without '
        "the object count only for F. ± is the standard deviation over the runs of a sequence.</p>",
        *(f'<p class="about">{escape(line)}</p>' for line in describe_flips(rows)),
        _plots(runs),
        "<h2>Sequences</h2>",
        _table(rows),
        "<h2>Attributes</h2>" if attributes else "",
        _attribute_table(rows, attributes) if attributes else "",
        "<h2>Worst failures</h2>" if strips else "",
        _LEGEND if strips else "",
        *map(_strip_html, strips),
        "<h2>Settings that are not the default</h2>",
        f"<pre>{changed or 'none'}</pre>",
    ]
    return write_page(path, "evaluation", body)


def write_strips(path: Path, runs: list[EvaluationRun], count: int) -> Path:
    """Write a page with film strips of the `count` worst runs. It reads their frames.

    Raises
    ------
    ServiceError
        If the file cannot be written.
    """
    strips = map(failure_strip, worst_runs(runs, count))
    return write_page(path, "failures", ["<h1>Worst failures</h1>", _LEGEND, *map(_strip_html, strips)])


def _plots(runs: list[EvaluationRun]) -> str:
    """Plot success and precision of each tracker, averaged over the sequences."""

    def curves(
        places: np.ndarray, measure: Callable[..., Float64], at: Callable[[Float64], float]
    ) -> dict[str, tuple[np.ndarray, Float64]]:
        by_tracker: dict[str, dict[str, list[Float64]]] = {}
        for run in runs:  # as in the table, the mean is taken first over the starts of a sequence
            by_tracker.setdefault(run.tracker, {}).setdefault(run.sequence.name, []).append(
                measure(run.boxes, run.truth)
            )
        means = {
            tracker: np.mean([np.mean(plots, axis=0) for plots in sequences.values()], axis=0)
            for tracker, sequences in by_tracker.items()
        }
        ranked = sorted(means.items(), key=lambda item: -at(item[1]))
        return {f"{tracker}  {at(curve):.3f}": (places, curve) for tracker, curve in ranked}

    overlap, distance = replace(SHARES, label="overlap threshold"), Axis.upto(PIXELS[-1], "distance in pixels")
    success = curves(OVERLAPS, success_plot, lambda curve: float(curve.mean()))
    precision = curves(PIXELS, precision_plot, lambda curve: float(curve[20]))
    left = plot("Success (AUC)", overlap, SHARES, success)
    right = plot("Precision (at 20 pixels)", distance, SHARES, precision)
    return f'<div class="plots">{left}{right}</div>'


def _table(rows: list[Row]) -> str:
    lines = [[escape(row.name), row.tracker, row.frames, *_shaded(cells(row))] for row in rows]
    means = mean_of(rows)
    lines += [["mean", tracker, "", *_shaded(cells(mean))] for tracker, mean in means.items()]
    return table(("sequence", "tracker", "frames", *MEASURES.values()), lines, texts=2, means=len(means))


def _attribute_table(rows: list[Row], attributes: Mapping[str, Sequence[str]]) -> str:
    lines = [
        [escape(attribute), tracker, len(attributes[attribute]), *_shaded(cells(mean))]
        for attribute, means in by_attribute(rows, attributes).items()
        for tracker, mean in means.items()
    ]
    return table(("attribute", "tracker", "sequences", *MEASURES.values()), lines, texts=2, means=0)


def _shaded(texts: list[str]) -> list[str]:
    """Give the measures from 0 to 1 a background that is darker for a higher value."""
    shades = [0 if text == "-" else 40 * float(text.partition(" ")[0]) ** 2 for text in texts[:-1]]
    style = "background: rgb(47 158 68 / {:.0f}%); padding: .1rem .3rem"
    shown = [f'<span style="{style.format(each)}">{text}</span>' for each, text in zip(shades, texts, strict=False)]
    return [*shown, texts[-1]]


def _strip_html(strip: FailureStrip) -> str:
    run = strip.run
    pictures = [figure(jpeg, f"frame {run.start.frame + row}") for row, jpeg in strip.pictures]
    return (
        f"<p><b>{escape(run.name)}</b>, {run.tracker}: wrong for {strip.length} frames from frame "
        f"{run.start.frame + strip.first} on; success {run.score().success:.3f}</p>\n"
        f'<div class="strip">{"".join(pictures)}</div>'
    )
