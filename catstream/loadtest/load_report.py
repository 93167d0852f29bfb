"""The results of a load test: tables of text, an HTML file with plots, and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from html import escape
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.text import counted
from catstream.loadtest.latency import PERCENTILES, percentiles
from catstream.loadtest.load_test import KINDS, MOST_STREAMS, LoadTest, Result, violations
from catstream.reports.page import Axis, plot, table, write_page
from catstream.reports.provenance import provenance

_STREAMS = 6  # maximum number of curves in a plot
_SUSTAINED = 0.01  # share of skipped frames up to which a rate counts as sustained
_POINTS = 200  # maximum number of points of a curve


class Table(NamedTuple):
    """A table of text: its title, rows of cells by the heads of their columns, and an explanation of the columns."""

    title: str
    rows: list[dict[str, str]]
    note: str = ""


def tables(result: Result) -> Iterator[Table]:
    """Yield the tables of a run: streams, processes and, if there were any, subscribers."""
    together = [{"stream": "all", **_latencies(result.track, result.model)}] if len(result.streams) > 1 else []
    streams = [
        {
            "stream": str(number),
            "frames/s": f"{each.rate(result.plan.rate):.1f}",
            "skipped": f"{100 * each.skipped_share:.1f} %",
            "cores": f"{result.cores(number):.2f}",
            "MB": f"{result.stream_memory(number) / 1e6:.0f}",
            **_latencies(each.track, each.model),
            "lag": str(each.max_lag),
            "not stored": _shown(each.not_stored, "d"),
            "success": _shown(each.success, ".3f"),
            "of tracked": _shown(each.success_followed, ".3f"),
        }
        for number, each in enumerate(result.streams)
    ]
    yield Table(
        "Streams",
        streams + together,
        "Cores: processor seconds per second of all processes of the stream; MB: their memory, in which a page that n "
        "processes share counts as 1/n of a page (PSS). Latencies in milliseconds. Lag: maximum number of messages "
        "that the compressor had not yet received. Not stored: features messages that were not in the coreset trees at "
        "the end. Success: share of frames with an overlap with the ground truth above 0.5; a skipped frame has the "
        "last known box. Of tracked: the same over the frames that were not skipped.",
    )
    processes = [
        {
            "process": name,
            "cores": f"{fmean(readings):.2f}",
            "cores, most": f"{max(readings):.2f}",
            "MB": f"{result.memory[name] / 1e6:.0f}" if name in result.memory else "-",
        }
        for name, readings in result.usage.items()
    ]
    if processes:
        yield Table("Processes", processes, "MB: as above (PSS), at the end of the run.")
    if (plan := result.plan).subscribers:
        subscribers = {
            "of each stream": plan.subscribers,
            "slow": plan.slow_subscribers - plan.frozen,
            "frozen": plan.frozen,
            "for s": round(result.frozen),
            "received, least": min(result.received, default=0),
            "received, most": max(result.received, default=0),
            "missed": sum(result.missed),
            "missed, most": max(result.missed, default=0),
        }
        yield Table(
            "Subscribers",
            [{head: str(number) for head, number in subscribers.items()}],
            "Frames whose tracks each of the fast subscribers received, and frames that they missed in total.",
        )


def milliseconds(seconds: float) -> str:
    return f"{1000 * seconds:.3g}" if seconds < 1 else f"{1000 * seconds:.0f}"


def _latencies(track: Float64, model: Float64) -> dict[str, str]:
    of_model = {f"model {name}": seconds for name, seconds in percentiles(model).items() if name in ("p50", "p99")}
    return {name: milliseconds(seconds) for name, seconds in (percentiles(track) | of_model).items()}


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


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
        "latency": {"track": percentiles(result.track), "model": percentiles(result.model)},
        "streams": [_stream(result, number) for number in range(len(result.streams))],
        "processes": {
            name: {"cores": fmean(readings), "cores_most": max(readings), "memory": result.memory.get(name)}
            for name, readings in result.usage.items()
        },
        "subscribers": {
            "quick": len(result.received),
            "received": sum(result.received),
            "missed": result.missed,
            "frozen_seconds": round(result.frozen, 3),
        },
        "camera_late": round(result.camera_late, 6),
        "limits": {limit.name: {"value": limit.value, "met": limit.is_met(result)} for limit in load_test.limits},
        "violations": load_test.violations,
        "highest_rate": load_test.highest if load_test.find == "rate" else None,
        "highest_streams": result.plan.streams if load_test.find == "streams" and load_test.highest else None,
        "steps": [
            {
                "rate": step.plan.rate,
                "streams": step.plan.streams,
                "skipped": KINDS["skipped"].measure(step),
                **dict(zip(("cores", "memory"), step.cost, strict=True)),
                "followed": step.followed,
                "track": {name: KINDS[name].measure(step) for name in PERCENTILES},
                "violations": violations(load_test.limits, step),
            }
            for step in load_test.results
        ],
        "refused": {f"{value:g}": reason for value, reason in load_test.refused.items()},
    }


def _stream(result: Result, number: int) -> dict[str, object]:
    measures = result.streams[number]
    return {
        "cores": result.cores(number),
        "memory": result.stream_memory(number),
        "frames": measures.frames,
        "frames_per_second": measures.rate(result.plan.rate),
        "skipped": measures.skipped,
        "without_track": measures.without_track,
        "track": percentiles(measures.track),
        "model": percentiles(measures.model),
        "lag": measures.max_lag,
        **{name: measures.totals.get(name) for name in ("sent", "stored", "restarts")},
        "success": measures.success,
        "success_followed": measures.success_followed,
    }


def write_report(path: Path, load_test: LoadTest) -> Path:
    """Write the report of the decisive run, and of the search steps."""
    result = load_test.result
    streams, *others = tables(result)
    kind = "good" if load_test.highest else "bad"
    return write_page(
        path,
        "load test",
        [
            "<h1>Load test</h1>",
            _verdict(result) if load_test.find != "streams" else f'<p class="{kind}">{escape(answer(load_test))}.</p>',
            f'<p class="about">{result.plan}, {result.seconds:.1f} s{", interrupted" * load_test.interrupted}. Latency '
            "counts from the due time of a frame; that of a skipped frame ends with the track of a newer one. The "
            f"camera was at most {milliseconds(result.camera_late)} ms late, and other processes of this machine kept "
            f"{result.other_load:.2f} cores busy.</p>",
            *(f'<p class="bad">{escape(error)}</p>' for error in result.errors),
            *(
                f'<p class="{"good" if limit.is_met(result) else "bad"}">{escape(limit.describe(result))}</p>'
                for limit in load_test.limits
            ),
            _html(_steps(load_test)) if load_test.find else "",
            f'<div class="plots">{"".join(_plots_of_steps(load_test))}</div>' if load_test.find else "",
            _html(streams),
            f'<div class="plots">{"".join(_plots(result))}</div>',
            *map(_html, others),
            "<h2>Settings that are not the default</h2>",
            f"<pre>{escape(chr(10).join(result.plan.settings.changed())) or 'none'}</pre>",
        ],
    )


def _html(shown: Table) -> str:
    heads = list(shown.rows[0])
    rows = [[escape(row.get(head, "")) for head in heads] for row in shown.rows]
    note = f'<p class="about">{shown.note}</p>' if shown.note else ""
    return f"<h2>{shown.title}</h2>{table(heads, rows, means=int(rows[-1][0] == 'all'))}{note}"


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


def answer(load_test: LoadTest) -> str:
    """How many streams this machine serves, or the highest rate, and what a stream costs."""
    if load_test.highest is None:
        what = "number of streams" if load_test.find == "streams" else "rate"
        return f"Interrupted before a {what} was found" if load_test.interrupted else f"No {what} meets the limits"
    if load_test.find == "rate":
        limits = ", ".join(map(str, load_test.limits))
        return f"The highest rate that meets {limits}: {load_test.highest:g} frames/s a stream"
    (cores, memory), most = load_test.result.cost, "at least " * (load_test.highest == MOST_STREAMS)
    return (
        f"This machine serves {most}{load_test.result.plan}; a stream takes {cores:.2f} cores and {memory / 1e6:.0f} MB"
    )


def _steps(load_test: LoadTest) -> Table:
    rows = [
        {
            "streams": f"{step.plan.streams}",
            "due": f"{step.plan.rate:g} frames/s",
            "limits": "; ".join(violations(load_test.limits, step)) or "met",
            "tracked": f"{step.followed:.1f}",
            "skipped": f"{100 * KINDS['skipped'].measure(step):.1f} %",
            **{f"{name} ms": milliseconds(KINDS[name].measure(step)) for name in PERCENTILES},
            "cores a stream": f"{step.cost[0]:.2f}",
            "MB a stream": f"{step.cost[1] / 1e6:.0f}",
        }
        for step in load_test.results
    ]
    refused = "".join(f" {value:g} streams did not start: {escape(why)}." for value, why in load_test.refused.items())
    note = f"The runs, in this order, with the figures of the worst stream; cores and MB are means.{refused}"
    title = answer(load_test) if load_test.find == "rate" else "The number of streams"
    return Table(title, rows, note)


def _plots_of_steps(load_test: LoadTest) -> Iterator[str]:
    """Plot the worst p99 and share of skipped frames over the parameter that was searched for."""
    steps = sorted(load_test.results, key=load_test.value)
    values = np.array([load_test.value(step) for step in steps])
    x = Axis.upto(float(values.max()), "streams" if load_test.find == "streams" else "frames/s")
    for name, factor, unit in (("p99", 1000, "ms"), ("skipped", 100, "%")):
        ys = factor * np.array([KINDS[name].measure(step) for step in steps])
        yield plot(f"{name} of the worst stream", x, Axis.upto(float(ys.max()), unit), {name: (values, ys)})


def _plots(result: Result) -> Iterator[str]:
    shown = {f"stream {number}": measures for number, measures in enumerate(result.streams[:_STREAMS])}
    yield _percentiles("From frame to track", {name: each.track for name, each in shown.items()})
    yield _percentiles("From frame to the model trained on it", {name: each.model for name, each in shown.items()})
    start = min(measures.due[0] for measures in shown.values())
    peaks = {name: _peaks(each.due - start, 1000 * each.track) for name, each in shown.items()}
    most = max(float(ys.max()) for _, ys in peaks.values())
    yield plot("Latency to the track over time", Axis.upto(result.seconds, "seconds"), Axis.upto(most, "ms"), peaks)


def _percentiles(title: str, streams: Mapping[str, Float64]) -> str:
    """Plot latency by percentile on a logarithmic axis: each tick to the right is a tenth of the remaining frames."""
    frames = max(map(len, streams.values()))
    nines = max(1, math.ceil(math.log10(frames)))  # the highest percentile is that of one frame
    ticks = tuple((float(nine), f"{100 - 100 / 10**nine:g} %") for nine in range(nines + 1))
    curves = {}
    for name, seconds in streams.items():
        slower = np.unique(np.geomspace(1, len(seconds), _POINTS).astype(int))  # frames that waited at least as long
        curves[name] = np.log10(len(seconds) / slower), 1000 * np.sort(seconds)[-slower]
    most = max(float(ys.max()) for _, ys in curves.values())
    return plot(title, Axis("share of frames that waited less", nines, ticks), Axis.upto(most, "ms"), curves)


def _peaks(xs: Float64, ys: Float64) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve to the maximum of each of `_POINTS` parts, so that no peak is lost."""
    begins = np.unique(np.linspace(0, len(xs), _POINTS, endpoint=False).astype(int))
    return xs[begins], np.maximum.reduceat(ys, begins)
