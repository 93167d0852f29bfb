"""The accuracy of runs: a row for each sequence, means, JSON, and a report in HTML."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from catstream.base.settings import Settings
from catstream.errors import CatstreamError
from catstream.measure.onepass import Run
from catstream.measure.scores import OVERLAPS, PIXELS, Score, precision_plot, success_plot
from catstream.output.report import write_page

#: The headings of `Row.cells`.
HEADINGS = ("AUC", "success", "precision", "norm. precision", "absence noticed", "falsely absent", "frames/s")


@dataclass(frozen=True, slots=True)
class Row:
    """The measures of a sequence; or over several sequences, means of measures and sums of numbers of frames.

    name   name of the sequence, or "mean"
    score  measures, see `scores.Score`
    fps    frames per second of the tracker without decoding
    """

    name: str
    frames: int
    score: Score
    fps: float

    @classmethod
    def of(cls, run: Run) -> Row:
        return cls(run.sequence.name, len(run.sequence), run.score(), run.fps)

    @classmethod
    def mean(cls, rows: Sequence[Row]) -> Row:
        measures: dict[str, Any] = {}
        for name, value in asdict(rows[0].score).items():
            values = [getattr(row.score, name) for row in rows]
            measures[name] = sum(values) if isinstance(value, int) else fmean(values)
        return cls("mean", sum(row.frames for row in rows), Score(**measures), fmean(row.fps for row in rows))

    def cells(self) -> list[str]:
        """Return the row as text: the name, the number of frames, and the cells of `HEADINGS`."""
        score = self.score
        measures = (score.auc, score.success, score.precision, score.normalised_precision)
        shares = _share(score.noticed, score.absent), _share(score.false, score.present)
        return [self.name, str(self.frames), *(f"{value:.3f}" for value in measures), *shares, f"{self.fps:.0f}"]


def _share(part: int, whole: int) -> str:
    if not whole:
        return "-"
    return f"{part}/{whole} {part / whole:.{0 if part / whole > 0.1 else 1}%}"


def to_json(rows: Sequence[Row], settings: Settings) -> dict[str, object]:
    """Return the JSON of `catstream evaluate --json`: version, changed settings, rows and mean."""
    *sequences, mean = (
        {"name": row.name, "frames": row.frames, **asdict(row.score), "fps": row.fps} for row in (*rows, Row.mean(rows))
    )
    return {"version": version("catstream"), "settings": settings.changed(), "sequences": sequences, "mean": mean}


def write_report(path: Path, runs: Sequence[Run], settings: Settings, errors: Sequence[CatstreamError] = ()) -> Path:
    """Write the report of an evaluation as a self-contained HTML file; `errors` are of the failed runs."""
    rows = [Row.of(run) for run in runs]
    return write_page(
        path,
        "evaluation.html",
        sequences=len(rows),
        frames=sum(row.frames for row in rows),
        errors=errors,
        plots=[*_plots(runs)],
        headings=[*HEADINGS],
        rows=[row.cells() for row in (*rows, Row.mean(rows))],
        settings=settings,
    )


def _plots(runs: Sequence[Run]) -> Iterator[dict[str, object]]:
    """Yield the success plot and the precision plot, averaged over the sequences, with the points of their curves."""
    for title, label, thresholds, measure in (
        ("Success", "overlap threshold", OVERLAPS, success_plot),
        ("Precision", "distance in pixels", PIXELS, precision_plot),
    ):
        high = float(thresholds[-1])
        shares = np.mean([measure(run.boxes, run.sequence.boxes) for run in runs], axis=0)
        points = np.column_stack([46 + 390 * thresholds / high, 276 - 240 * shares])
        curve = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        yield {"title": title, "label": label, "high": high, "curve": curve}
