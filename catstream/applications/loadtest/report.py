"""Writes the report of a load test as one HTML file with figures and plots."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape
from pathlib import Path

import numpy as np

from catstream.applications.html.page import table, write_page
from catstream.applications.html.plots import Axis, plot
from catstream.applications.loadtest.latencies import PERCENTILES, Latencies
from catstream.applications.loadtest.load_test import LoadTest
from catstream.applications.loadtest.measures import Measures
from catstream.applications.loadtest.run import Result
from catstream.applications.loadtest.usage import REST, summary
from catstream.messages.names import counted

__all__ = ["write_report"]

_STREAMS = 6  # maximum number of curves in a plot
_SUSTAINED = 0.01  # share of skipped frames up to which a rate counts as sustained
_POINTS = 200  # maximum number of points of a curve over time


def write_report(path: Path, load_test: LoadTest) -> Path:
    """Write the report of the decisive run, and of the search steps.

    Raises
    ------
    VideoError
        If the file cannot be written.
    """
    result = load_test.result
    plan = result.plan
    about = (
        f"{plan}, {result.seconds:.1f} s{', interrupted' if load_test.interrupted else ''}. Latency counts from the "
        "due time of a frame; the latency of a skipped frame ends with the track of a newer one."
    )
    return write_page(
        path,
        "load test",
        [
            "<h1>Load test</h1>",
            _verdict(result),
            f'<p class="about">{about}</p>',
            *(f'<p class="bad">{escape(error)}</p>' for error in result.errors),
            _limits(load_test),
            _steps(load_test),
            "<h2>Streams</h2>",
            _streams(result),
            _plots(result),
            "<h2>Processes</h2>",
            _processes(result),
            _subscribers(result),
            _chaos(result),
            "<h2>Reliability</h2>",
            '<p class="about">The precision of the latencies is the largest delay that the camera itself caused: '
            f"{_ms(result.camera_late)} ms. Other processes of this machine kept {result.other_load:.2f} cores busy; "
            "on a quiet machine it is close to 0.</p>",
            "<h2>Settings that are not the default</h2>",
            f"<pre>{escape(chr(10).join(plan.settings.changed()) or 'none')}</pre>",
        ],
    )


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


def _limits(load_test: LoadTest) -> str:
    lines = []
    for limit in load_test.limits:
        style, word = ("good", "met") if limit.is_met(load_test.result) else ("bad", "broken")
        lines.append(f'<li class="{style}">{word}: {escape(limit.describe(load_test.result))}</li>')
    return f"<ul>{''.join(lines)}</ul>" if lines else ""


def _steps(load_test: LoadTest) -> str:
    if not load_test.is_search:
        return ""
    rows = []
    for step in load_test.steps:
        style, verdict = ("bad", "; ".join(step.violations)) if step.violations else ("good", "met")
        latencies = [_ms(step.result.track[name]) for name in PERCENTILES]
        rows.append(
            [
                f"{step.rate:g} frames/s",
                f'<span class="{style}">{escape(verdict)}</span>',
                f"{step.followed:.1f}",
                *latencies,
            ]
        )
    heads = ["due", "limits", "tracked", *(f"{name} ms" for name in PERCENTILES)]
    if load_test.highest_rate:
        title = f"The highest rate that meets the limits: {load_test.highest_rate:g} frames/s"
    else:
        title = "Interrupted before a rate was found" if load_test.interrupted else "No rate meets the limits"
    return f'<h2>{title}</h2><p class="about">The runs, in this order.</p>{table(heads, rows, texts=2)}'


def _streams(result: Result) -> str:
    heads = ["stream", "frames", "frames/s", "skipped", *(f"track {name}" for name in PERCENTILES)]
    heads += [f"model {name}" for name in ("p50", "p99")] + ["lag", "not stored", "success", "success of tracked"]
    rows = [
        [
            number,
            measures.frames,
            f"{measures.rate(result.plan.rate):.1f}",
            f"{100 * measures.skipped_share:.1f} %",
            *(_ms(measures.track[name]) for name in PERCENTILES),
            *(_ms(measures.model[name]) for name in ("p50", "p99")),
            measures.max_lag,
            "-" if measures.sent is None or measures.stored is None else measures.sent - measures.stored,
            _share(measures.success),
            _share(measures.success_followed),
        ]
        for number, measures in enumerate(result.streams)
    ]
    several = len(rows) > 1
    if several:
        latencies = [_ms(result.track[name]) for name in PERCENTILES] + [
            _ms(result.model[name]) for name in ("p50", "p99")
        ]
        rows.append(["all", sum(stream.frames for stream in result.streams), "", "", *latencies, "", "", "", ""])
    note = (
        '<p class="about">Latencies in milliseconds. Lag: maximum number of messages that the compressor had not yet '
        "received. Success: share of frames with an overlap with the ground truth above 0.5; a skipped frame has the "
        "last known box. Success of tracked: the same over the frames that were not skipped. Not stored: features "
        "messages that were not in the coreset trees at the end.</p>"
    )
    return table(heads, rows, means=several) + note


def _plots(result: Result) -> str:
    shown = list(enumerate(result.streams))[:_STREAMS]
    start = min(measures.due[0] for _, measures in shown)
    seconds = Axis.upto(result.seconds, "seconds")
    over_time, lag, rates = {}, {}, {}
    for number, measures in shown:
        when = measures.due - start
        over_time[f"stream {number}"] = _thinned(when, 1000 * measures.track.seconds)
        rates[f"stream {number}"] = _rate(measures, when, result.plan.rate)
        reports = np.array(measures.lag, float).reshape(-1, 2)
        lag[f"stream {number}"] = reports[:, 0] - start, reports[:, 1]
    parts = [
        _percentiles("From frame to track", [measures.track for _, measures in shown]),
        _percentiles("From frame to the model trained on it", [measures.model for _, measures in shown]),
        _lines("Latency to the track over time", seconds, "ms", over_time),
        _lines("Frames tracked", seconds, "frames/s", rates, minimum=result.plan.rate),
        _lines("Lag of the compressor", seconds, "messages", lag, minimum=5),
    ]
    for title, unit, column, scale in (("Processor", "cores", 1, 1.0), ("Memory", "MB", 2, 1e-6)):
        kinds = _kinds(result, column, scale, start)
        if title == "Memory":  # that of all other programs would set the scale
            kinds.pop(REST, None)
        parts.append(_lines(title, seconds, unit, kinds))
    return f'<div class="plots">{"".join(parts)}</div>'


def _percentiles(title: str, streams: Iterable[Latencies]) -> str:
    """Plot latency by percentile on a logarithmic axis: each tick to the right is a tenth of the remaining frames."""
    streams = list(streams)
    nines = max(1, math.ceil(math.log10(max(map(len, streams)))))  # the highest percentile is that of one frame
    ticks = tuple((float(nine), f"{100 - 100 / 10**nine:g} %") for nine in range(nines + 1))
    curves = {}
    for number, latencies in enumerate(streams):
        ordered = 1000 * np.sort(latencies.seconds)
        above = 1 - np.arange(len(ordered)) / len(ordered)  # share of the frames with this latency or a longer one
        curves[f"stream {number}"] = _thinned(-np.log10(above), ordered)
    most = max(float(ys.max()) for _, ys in curves.values())
    return plot(title, Axis("share of frames that waited less", nines, ticks), Axis.upto(most, "ms"), curves)


def _lines(
    title: str, x: Axis, unit: str, curves: dict[str, tuple[np.ndarray, np.ndarray]], minimum: float = 1.0
) -> str:
    most = max((float(ys.max()) for _, ys in curves.values() if len(ys)), default=0.0)
    return plot(title, x, Axis.upto(max(most, minimum), unit), curves)


def _thinned(xs: np.ndarray, ys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve to the maximum of each of `_POINTS` intervals, so that no peak is lost."""
    if len(xs) <= _POINTS:
        return xs, ys
    places = np.linspace(xs[0], xs[-1], _POINTS)
    stretch = np.searchsorted(places, xs)
    most = np.full(_POINTS, np.nan)
    np.fmax.at(most, stretch, ys)
    known = np.isfinite(most)
    return places[known], most[known]


def _rate(measures: Measures, when: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of tracked frames in each second."""
    seconds = (when - when[0]).astype(int)
    share = np.bincount(seconds, measures.followed) / np.bincount(seconds)
    return np.arange(len(share)) + 0.5, rate * share


def _kinds(result: Result, column: int, scale: float, start: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the readings of each kind of process, summed over the streams."""
    kinds: dict[str, list[np.ndarray]] = {}
    for name, readings in result.usage.items():
        kinds.setdefault(name.rstrip(" 0123456789"), []).append(np.array(readings, float))
    moments = np.unique([reading.moment for readings in result.usage.values() for reading in readings])
    added = {}
    for kind, several in kinds.items():
        total = np.zeros(len(moments))
        for series in several:
            total[np.searchsorted(moments, series[:, 0])] += scale * series[:, column]
        added[kind] = moments - start, total
    return added


def _processes(result: Result) -> str:
    rows = []
    for name, readings in result.usage.items():
        found = summary(readings)
        cores, memory = (found["cores"], found["cores_most"]), (found["memory"], found["memory_most"])
        rows.append([escape(name), *(f"{value:.2f}" for value in cores), *(f"{value / 1e6:.0f}" for value in memory)])
    return table(["process", "cores, mean", "most", "MB, mean", "most"], rows)


def _subscribers(result: Result) -> str:
    plan = result.plan
    if not plan.subscribers:
        return ""
    received, missed = result.received or [0], result.missed or [0]
    return (
        f'<h2>Subscribers</h2><p class="about">{plan.subscribers} to each stream, of which {plan.slow} are slow; '
        f"{plan.frozen} of these were frozen for {result.frozen:.0f} s. The fast ones received the tracks of "
        f"{min(received)} to {max(received)} frames each, and missed those of {sum(missed)} in total, "
        f"{max(missed)} at most.</p>"
    )


def _chaos(result: Result) -> str:
    if not result.plan.chaos:
        return ""
    rows = [[str(recovery.kill), _seconds(recovery.track), _seconds(recovery.model)] for recovery in result.recoveries]
    heads = ["killed", "s to the next track", "s to the next model"]
    title = f"Chaos: {len(rows)} processes killed, {result.restarts} restarted"
    return f"<h2>{title}</h2>{table(heads, rows)}"


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.3g}" if seconds < 1 else f"{1000 * seconds:.0f}"


def _seconds(seconds: float | None) -> str:
    return "none" if seconds is None else f"{seconds:.3f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
