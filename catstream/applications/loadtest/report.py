"""The results of a load test: tables of text, an HTML file with plots, and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catstream.applications.evaluation.provenance import provenance
from catstream.applications.html.page import table, write_page
from catstream.applications.html.plots import Axis, plot
from catstream.applications.loadtest.latencies import PERCENTILES, Latencies
from catstream.applications.loadtest.limits import violations
from catstream.applications.loadtest.load_test import LoadTest
from catstream.applications.loadtest.measures import Measures
from catstream.applications.loadtest.run import Result
from catstream.applications.loadtest.usage import REST, summary
from catstream.messages.names import counted

__all__ = ["Table", "milliseconds", "tables", "to_json", "write_report"]

_STREAMS = 6  # maximum number of curves in a plot
_SUSTAINED = 0.01  # share of skipped frames up to which a rate counts as sustained
_POINTS = 200  # maximum number of points of a curve over time
_MODEL = ("p50", "p99")  # percentiles of the model latency that are shown

Curves = dict[str, tuple[np.ndarray, np.ndarray]]


class Table(NamedTuple):
    """A table of text.

    note   explanation of the columns
    means  number of rows at the end that summarise the others
    texts  number of columns of words, the first ones
    """

    title: str
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""
    means: int = 0
    texts: int = 1


def tables(result: Result) -> Iterator[Table]:
    """Yield the tables of a run: streams, processes and, if there were any, subscribers and kills."""
    streams = [
        (
            str(number),
            f"{each.rate(result.plan.rate):.1f}",
            f"{100 * each.skipped_share:.1f} %",
            *_latencies(each.track, each.model),
            str(each.max_lag),
            "-" if each.not_stored is None else str(each.not_stored),
            _share(each.success),
            _share(each.success_followed),
        )
        for number, each in enumerate(result.streams)
    ]
    together = [("all", "", "", *_latencies(result.track, result.model), *[""] * 4)] if len(streams) > 1 else []
    yield Table(
        "Streams",
        (
            *("stream", "frames/s", "skipped", *PERCENTILES, *(f"model {name}" for name in _MODEL)),
            *("lag", "not stored", "success", "of tracked"),
        ),
        streams + together,
        "Latencies in milliseconds. Lag: maximum number of messages that the compressor had not yet received. Not "
        "stored: features messages that were not in the coreset trees at the end. Success: share of frames with an "
        "overlap with the ground truth above 0.5; a skipped frame has the last known box. Of tracked: the same over "
        "the frames that were not skipped.",
        len(together),
    )
    used = {name: summary(readings) for name, readings in result.usage.items()}
    processes = [
        (
            name,
            *(f"{use[key]:.2f}" for key in ("cores", "cores_most")),
            *(f"{use[key] / 1e6:.0f}" for key in ("memory", "memory_most")),
        )
        for name, use in used.items()
    ]
    yield Table("Processes", ("process", "cores", "most", "MB", "most"), processes)
    if plan := result.plan.subscribers and result.plan:
        yield Table(
            "Subscribers",
            ("of each stream", "slow", "frozen", "for s", "received, least", "most", "missed", "most"),
            [
                (
                    *map(str, (plan.subscribers, plan.slow_subscribers - plan.frozen, plan.frozen)),
                    f"{result.frozen:.0f}",
                    *(str(pick(result.received, default=0)) for pick in (min, max)),
                    *(str(value) for value in (sum(result.missed), max(result.missed, default=0))),
                )
            ],
            "Frames whose tracks each of the fast subscribers received, and frames that they missed in total.",
        )
    if result.plan.chaos:
        yield Table(
            f"Chaos: {len(result.recoveries)} processes killed, {result.restarts} restarted",
            ("killed", "s to the next track", "s to the next model"),
            [(str(each.kill), _seconds(each.track), _seconds(each.model)) for each in result.recoveries],
        )


def milliseconds(seconds: float) -> str:
    """Format a duration in milliseconds."""
    return f"{1000 * seconds:.3g}" if seconds < 1 else f"{1000 * seconds:.0f}"


def _latencies(track: Latencies, model: Latencies) -> tuple[str, ...]:
    return *(milliseconds(track[name]) for name in PERCENTILES), *(milliseconds(model[name]) for name in _MODEL)


def _seconds(seconds: float | None) -> str:
    return "none" if seconds is None else f"{seconds:.3f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def to_json(load_test: LoadTest) -> dict[str, object]:
    """Return the figures of the decisive run, those of the search steps, and the provenance.

    Units are seconds, bytes, and shares from 0 to 1.
    """
    result = load_test.result
    plan = {each.name: getattr(result.plan, each.name) for each in fields(result.plan) if each.name != "settings"}
    return {
        **provenance(result.plan.settings),
        "plan": plan,
        "seconds": result.seconds,
        "interrupted": load_test.interrupted,
        "latency": {"track": result.track.figures(), "model": result.model.figures()},
        "streams": [_stream(measures, result.plan.rate) for measures in result.streams],
        "processes": {name: summary(readings) for name, readings in result.usage.items()},
        "subscribers": {
            "quick": len(result.received),
            "received": sum(result.received),
            "missed": result.missed,
            "frozen_seconds": round(result.frozen, 3),
        },
        "chaos": [
            {
                "stream": recovery.kill.stream,
                "process": recovery.kill.process,
                "to_track": recovery.track,
                "to_model": recovery.model,
            }
            for recovery in result.recoveries
        ],
        "restarts": result.restarts,
        "camera_late": round(result.camera_late, 6),
        "limits": {limit.name: {"value": limit.value, "met": limit.is_met(result)} for limit in load_test.limits},
        "violations": load_test.violations,
        "highest_rate": load_test.highest_rate,
        "steps": [
            {
                "rate": step.plan.rate,
                "followed": step.followed,
                "track": step.track.figures(),
                "violations": violations(load_test.limits, step),
            }
            for step in load_test.results
        ],
    }


def _stream(measures: Measures, rate: float) -> dict[str, object]:
    return {
        "frames": measures.frames,
        "frames_per_second": measures.rate(rate),
        "skipped": measures.skipped,
        "without_track": measures.without_track,
        "track": measures.track.figures(),
        "model": measures.model.figures(),
        "lag": measures.max_lag,
        "sent": measures.totals.get("sent"),
        "stored": measures.totals.get("stored"),
        "success": measures.success,
        "success_followed": measures.success_followed,
    }


def write_report(path: Path, load_test: LoadTest) -> Path:
    """Write the report of the decisive run, and of the search steps.

    Raises
    ------
    VideoError
        If the file cannot be written.
    """
    result = load_test.result
    streams, *others = tables(result)
    return write_page(
        path,
        "load test",
        [
            "<h1>Load test</h1>",
            _verdict(result),
            f'<p class="about">{result.plan}, {result.seconds:.1f} s{", interrupted" * load_test.interrupted}. Latency '
            "counts from the due time of a frame; that of a skipped frame ends with the track of a newer one.</p>",
            *(f'<p class="bad">{escape(error)}</p>' for error in result.errors),
            *(
                f'<p class="{"good" if limit.is_met(result) else "bad"}">{escape(limit.describe(result))}</p>'
                for limit in load_test.limits
            ),
            _html(_steps(load_test)) if load_test.is_search else "",
            _html(streams),
            f'<div class="plots">{"".join(_plots(result))}</div>',
            *map(_html, others),
            "<h2>Reliability</h2>",
            '<p class="about">The precision of the latencies is the largest delay that the camera itself caused: '
            f"{milliseconds(result.camera_late)} ms. Other processes of this machine kept {result.other_load:.2f} "
            "cores busy; on a quiet machine it is close to 0.</p>",
            "<h2>Settings that are not the default</h2>",
            f"<pre>{escape(chr(10).join(result.plan.settings.changed()) or 'none')}</pre>",
        ],
    )


def _html(shown: Table) -> str:
    rows = [[escape(cell) for cell in row] for row in shown.rows]
    note = f'<p class="about">{shown.note}</p>' if shown.note else ""
    return f"<h2>{shown.title}</h2>{table(shown.heads, rows, texts=shown.texts, means=shown.means)}{note}"


def _verdict(result: Result) -> str:
    """Whether every stream was followed at its rate, or where and when most frames were skipped."""
    worst, measures = max(enumerate(result.streams), key=lambda each: each[1].skipped_share)
    rate = f"{counted(len(result.streams), 'stream')} of {result.plan.rate:g} frames/s"
    if measures.skipped_share <= _SUSTAINED:
        most = f"at most {100 * measures.skipped_share:.1f} % of the frames skipped"
        return f'<p class="good">Sustained: {rate}, {most}.</p>'
    since = measures.due[~measures.followed][0] - measures.due[0]
    return (
        f'<p class="bad">Not sustained: of {rate}, stream {worst} skipped {100 * measures.skipped_share:.1f} % of its '
        f"frames, the first after {since:.1f} s: it was followed at {measures.rate(result.plan.rate):.1f} frames/s.</p>"
    )


def _steps(load_test: LoadTest) -> Table:
    if load_test.highest_rate:
        title = f"The highest rate that meets the limits: {load_test.highest_rate:g} frames/s"
    else:
        title = "Interrupted before a rate was found" if load_test.interrupted else "No rate meets the limits"
    rows = [
        (
            f"{step.plan.rate:g} frames/s",
            "; ".join(violations(load_test.limits, step)) or "met",
            f"{step.followed:.1f}",
            *(milliseconds(step.track[name]) for name in PERCENTILES),
        )
        for step in load_test.results
    ]
    heads = ("due", "limits", "tracked", *(f"{name} ms" for name in PERCENTILES))
    return Table(title, heads, rows, "The runs, in this order.", texts=2)


def _plots(result: Result) -> Iterator[str]:
    shown = {f"stream {number}": measures for number, measures in enumerate(result.streams[:_STREAMS])}
    start = min(measures.due[0] for measures in shown.values())
    seconds = Axis.upto(result.seconds, "seconds")
    yield _percentiles("From frame to track", {name: measures.track for name, measures in shown.items()})
    yield _percentiles("From frame to the model trained on it", {name: each.model for name, each in shown.items()})
    latencies = {name: _peaks(each.due - start, 1000 * each.track.seconds) for name, each in shown.items()}
    yield _lines("Latency to the track over time", seconds, "ms", latencies)
    rates = {name: _rate(each, each.due - start, result.plan.rate) for name, each in shown.items()}
    yield _lines("Frames tracked", seconds, "frames/s", rates, minimum=result.plan.rate)
    reports = {name: np.array(each.lag, float).reshape(-1, 2) for name, each in shown.items()}
    lag = {name: (each[:, 0] - start, each[:, 1]) for name, each in reports.items()}
    yield _lines("Lag of the compressor", seconds, "messages", lag, minimum=5)
    yield _lines("Processor", seconds, "cores", _used(result, 1, start))
    memory = {name: (xs, ys / 1e6) for name, (xs, ys) in _used(result, 2, start).items()}
    memory.pop(REST, None)  # that of all other programs would set the scale
    yield _lines("Memory", seconds, "MB", memory)


def _percentiles(title: str, streams: Mapping[str, Latencies]) -> str:
    """Plot latency by percentile on a logarithmic axis: each tick to the right is a tenth of the remaining frames."""
    nines = max(
        1, math.ceil(math.log10(max(map(len, streams.values()))))
    )  # the highest percentile is that of one frame
    ticks = tuple((float(nine), f"{100 - 100 / 10**nine:g} %") for nine in range(nines + 1))
    curves = {}
    for name, latencies in streams.items():
        shares, values = latencies.distribution()
        curves[name] = -np.log10(np.maximum(1 - shares, 10.0**-nines)), 1000 * values
    most = max(float(ys.max()) for _, ys in curves.values())
    return plot(title, Axis("share of frames that waited less", nines, ticks), Axis.upto(most, "ms"), curves)


def _lines(title: str, x: Axis, unit: str, curves: Curves, minimum: float = 1.0) -> str:
    most = max((float(ys.max()) for _, ys in curves.values() if len(ys)), default=0.0)
    return plot(title, x, Axis.upto(max(most, minimum), unit), curves)


def _peaks(xs: np.ndarray, ys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve to the maximum of each of `_POINTS` parts, so that no peak is lost."""
    begins = np.unique(np.linspace(0, len(xs), _POINTS, endpoint=False).astype(int))
    return xs[begins], np.maximum.reduceat(ys, begins)


def _rate(measures: Measures, when: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of tracked frames in each second."""
    seconds = (when - when[0]).astype(int)
    share = np.bincount(seconds, measures.followed) / np.bincount(seconds)
    return np.arange(len(share)) + 0.5, rate * share


def _used(result: Result, column: int, start: float) -> Curves:
    """Return a column of the readings of each kind of process, summed over the streams."""
    kinds: dict[str, dict[float, float]] = {}
    for name, readings in result.usage.items():
        kind = kinds.setdefault(name.rstrip(" 0123456789"), {})
        for reading in readings:
            kind[reading.moment] = kind.get(reading.moment, 0.0) + reading[column]
    return {kind: (np.array([*sums]) - start, np.array([*sums.values()])) for kind, sums in kinds.items()}
