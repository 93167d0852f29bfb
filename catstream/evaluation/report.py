"""The report: one HTML file with all in it, that opens anywhere and needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Callable
from html import escape
from pathlib import Path

import numpy as np

from catstream.errors import VideoError
from catstream.evaluation.films import Film, film_of, worst
from catstream.evaluation.metrics import OVERLAPS, PIXELS, precision_plot, success_plot
from catstream.evaluation.plots import plot
from catstream.evaluation.runs import Run
from catstream.evaluation.summary import Row, mean_of, rows_of
from catstream.settings import Settings

__all__ = ["write_report"]

_FILMS = 8

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8881; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1060px; margin: 2.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p.about, figcaption { opacity: .75; margin: .2rem 0; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: .22rem .55rem; text-align: right; border-bottom: 1px solid var(--line); }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
tr.mean td { font-weight: 600; } small { opacity: .65; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(380px, 1fr)); gap: 1.2rem; }
svg text { font-size: 12px; fill: currentColor; } svg .title { font-size: 14px; font-weight: 600; }
svg .grid { stroke: var(--line); }
.film { display: flex; gap: .5rem; overflow-x: auto; padding-bottom: .4rem; }
.film figure { margin: 0; } .film img { display: block; border-radius: 4px; }
.film figcaption { font-size: 12px; }
pre { background: var(--soft); padding: .8rem; border-radius: 6px; overflow-x: auto; }
"""


def write_report(path: Path, runs: list[Run], settings: Settings) -> Path:
    """Write the report of an evaluation; reads frames for the film strips of the worst runs.

    Raises
    ------
    VideoError
        Where the file cannot be written.
    """
    rows = rows_of(runs)
    films = [film_of(run) for run in worst(runs, _FILMS)]
    sequences, frames = len({row.name for row in rows}), sum({row.name: row.frames for row in rows}.values())
    changed = {name: value for name, value in settings.values().items() if value != getattr(Settings(), name)}
    body = [
        "<h1>How well it follows</h1>",
        f'<p class="about">{sequences} sequences, {frames:,} frames, {len(runs)} runs, one pass each. Frames without '
        "the object do not count, except for F.</p>",
        _plots(runs),
        "<h2>Sequences</h2>",
        _table(rows),
        "<h2>Worst failures</h2>" if films else "",
        '<p class="about">White: the truth. Orange: the tracker.</p>' if films else "",
        *map(_film, films),
        "<h2>Settings that are not the default</h2>",
        f"<pre>{escape(chr(10).join(f'{name} = {value!r}' for name, value in changed.items()) or 'none')}</pre>",
    ]
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>catstream: evaluation</title>\n'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>\n<body>\n'
        + "\n".join(part for part in body if part)
        + "\n</body></html>\n"
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise VideoError(f"cannot write the report {str(path)!r} ({error.strerror}): give another folder") from None
    return path


def _plots(runs: list[Run]) -> str:
    """Success and precision, averaged over the runs of each tracker."""

    def curves(measure: Callable[..., np.ndarray], at: Callable[[np.ndarray], float]) -> dict[str, np.ndarray]:
        trackers = dict.fromkeys(run.tracker for run in runs)
        means = {
            tracker: np.mean([measure(run.boxes, run.truth) for run in runs if run.tracker == tracker], axis=0)
            for tracker in trackers
        }
        ranked = sorted(means.items(), key=lambda item: -at(item[1]))
        return {f"{tracker}  {at(curve):.3f}": curve for tracker, curve in ranked}

    success = plot(
        "Success (AUC)", "overlap threshold", OVERLAPS, curves(success_plot, lambda curve: float(curve.mean()))
    )
    precision = plot(
        "Precision (at 20 pixels)", "distance in pixels", PIXELS, curves(precision_plot, lambda curve: float(curve[20]))
    )
    return f'<div class="plots">{success}{precision}</div>'


def _table(rows: list[Row]) -> str:
    heads = ("sequence", "tracker", "frames", "AUC", "success", "precision", "norm. precision", "F", "frames/s")
    lines = [f"<tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>"]
    for row in rows:
        auc, success = _share(row.auc), _share(row.success)
        if row.starts > 1:
            auc += f" <small>±{row.auc_spread:.3f}</small>"
            success += f" <small>±{row.success_spread:.3f}</small>"
        rest = (row.precision, row.normalised_precision, row.f_score)
        cells = [escape(row.name), row.tracker, row.frames, auc, success, *map(_share, rest), f"{row.fps:.0f}"]
        lines.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    for tracker, mean in mean_of(rows).items():
        shares = [_share(mean[name]) for name in ("auc", "success", "precision", "normalised_precision", "f_score")]
        cells = ["mean", tracker, "", *shares, f"{mean['fps']:.0f}"]
        lines.append(f'<tr class="mean">{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>')
    return f"<table>\n{chr(10).join(lines)}\n</table>"


def _share(value: float | None) -> str:
    """A number with its size behind it: darker is better."""
    if value is None:
        return "<small>-</small>"
    return (
        f'<span style="background: rgb(47 158 68 / {40 * value * value:.0f}%); padding: .1rem .3rem">{value:.3f}</span>'
    )


def _film(film: Film) -> str:
    run, pictures = film.run, []
    for row, jpeg in film.pictures:
        number = f"frame {run.start + row}"
        source = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"
        pictures.append(f'<figure><img alt="{number}" src="{source}"><figcaption>{number}</figcaption></figure>')
    return (
        f"<p><b>{escape(run.name)}</b>, {run.tracker}: wrong for {film.length} frames from frame "
        f"{run.start + film.first} on; success {run.score().success:.3f}</p>\n"
        f'<div class="film">{"".join(pictures)}</div>'
    )
