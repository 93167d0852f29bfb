"""The results of a load test as text tables, HTML and JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.tables import write_table
from catstream.measure.latency import PERCENTILES, percentiles
from catstream.measure.load_result import KINDS, SEARCHES, SHARES, Result, violations
from catstream.measure.load_test import LoadTest
from catstream.measure.timeline import timeline
from catstream.output.report import COLOURS, round_up, write_page


class Table(NamedTuple):
    """A table of text: title, rows of cells by column header, and an explanation of the columns."""

    title: str
    rows: list[dict[str, str]]
    note: str

    @property
    def headers(self) -> list[str]:
        return list(self.rows[0])

    @property
    def cells(self) -> list[list[str]]:
        return [[row.get(header, "") for header in self.headers] for row in self.rows]


def tables(result: Result) -> Iterator[Table]:
    """Yield the tables of a run: streams, processes and subscribers."""
    streams = [
        {
            "stream": str(number),
            "frames/s": f"{result.rate(stream.skipped):.1f}",
            "skipped": f"{100 * stream.skipped:.1f} %",
            **_cost(*result.cost(number)),
            **_latencies(stream.track, stream.model),
            "not stored": str(stream.totals["sent"] - stream.totals["stored"]) if stream.totals else "-",
            "success": f"{stream.success:.3f}",
        }
        for number, stream in enumerate(result.streams)
    ]
    if len(streams) > 1:
        streams.append({"stream": "all", **_latencies(result.track, result.model)})
    yield Table(
        "Streams",
        streams,
        "Cores: processor seconds per second of all processes of the stream; MB: their memory, in which a page that n "
        "processes share counts as 1/n of a page (PSS). Latencies in milliseconds. Not stored: features "
        "messages that were not in the coreset trees at the end. Success: share of frames with an IoU above 0.5 with "
        f"the {'unloaded run' if result.plan.video else 'ground truth'}; a skipped frame has the last box.",
    )
    processes = [{"process": name, **_cost(cores, result.memory.get(name))} for name, cores in result.cores.items()]
    yield Table("Processes", processes, "MB: as above (PSS), at the end of the run.")
    if result.subscribers:
        subscribers = [
            {
                "channel": receipts.channel,
                "stream": str(receipts.stream),
                "fast": str(len(receipts.received)),
                "slow": str(result.plan.slow_subscribers),
                **{name: milliseconds(seconds) for name, seconds in percentiles(receipts.latency).items()},
                "p99, slowest": milliseconds(max(percentiles(row)["p99"] for row in receipts.latency)),
                "missed": str(sum(receipts.missed)),
                "missed, most": str(max(receipts.missed)),
            }
            for receipts in result.subscribers
        ]
        yield Table(
            "Subscribers",
            subscribers,
            "Milliseconds from the due time of a frame to its receipt by a fast subscriber, and the p99 of the slowest "
            "one. Missed: frames whose messages were lost, of all subscribers together, and at most of one.",
        )


class Panel(NamedTuple):
    """A panel of the chart over time: title, value at its upper edge, and curves by name, in 1000 x 100 units."""

    title: str
    top: float
    curves: dict[str, str]


def panels(over_time: dict[str, list[float]], due: float) -> Iterator[Panel]:
    """Yield the panels of the chart, which share a time axis; `due` is the number of due frames per second."""
    figures = {name: np.array(values) for name, values in over_time.items()}
    x = 1000 * (np.arange(len(figures["seconds"])) + 0.5) / len(figures["seconds"])  # centres of the intervals
    latencies = {
        name.replace("-", " at subscribers, "): 1000 * values
        for name, values in figures.items()
        if name.endswith(("p50", "p99"))
    }
    cores = {"pipelines": "cores", "rest of the load test": "load_cores", "other processes": "other_cores"}
    for title, curves in (
        ("Latency, ms", latencies),
        ("Frames/s", {"tracked": figures["frames_per_second"], "skipped": due * figures["skipped"]}),
        ("Busy cores", {name: figures[key] for name, key in cores.items()}),
        ("Memory (PSS), MB", {"pipelines": figures["memory"] / 1e6}),
    ):
        top = round_up(max(0.1, *(float(values.max()) for values in curves.values())))
        lines = {name: zip(x, 100 - 100 * values / top, strict=True) for name, values in curves.items()}
        yield Panel(title, top, {name: " ".join(f"{x:.1f},{y:.1f}" for x, y in line) for name, line in lines.items()})


def write_raw(path: Path, result: Result) -> None:
    """Write a CSV file with a row for each frame and each receiver, the load test or a fast subscriber."""

    def rows() -> Iterator[tuple[object, ...]]:
        for number, stream in enumerate(result.streams):
            latencies = [("tracks", "", stream.track), ("models", "", stream.model)]
            for each in result.subscribers:
                if each.stream == number:
                    latencies += [(each.channel, str(index), row) for index, row in enumerate(each.latency)]
            texts = [f"{due:.6f}" for due in stream.due - result.streams[0].due[0]]
            frames = [*zip(range(len(texts)), texts, map(int, stream.tracked), strict=True)]
            for channel, subscriber, latency in latencies:
                for frame, seconds in zip(frames, latency, strict=True):
                    yield number, channel, subscriber, *frame, f"{seconds:.6f}"

    columns = ("stream", "channel", "subscriber", "frame", "due_seconds", "tracked", "latency_seconds")
    write_table(path, columns, rows())


def milliseconds(seconds: float) -> str:
    return f"{1000 * seconds:.3g}" if seconds < 1 else f"{1000 * seconds:.0f}"


def figure(name: str, value: float) -> str:
    """Format a figure by its name, with its unit.

    >>> figure("p99", 0.0234), figure("skipped", 0.005), figure("memory", 2e8), figure("cores", 0.3)
    ('23.4 ms', '0.5 %', '200 MB', '0.30')
    """
    if name in SHARES:
        return f"{100 * value:.4g} %"
    if name == "memory":
        return f"{value / 1e6:.0f} MB"
    return f"{value:.2f}" if name == "cores" else f"{milliseconds(value)} ms" if name in KINDS else f"{value:g}"


def _latencies(track: Float64, model: Float64) -> dict[str, str]:
    of_model = {f"model {name}": percentiles(model)[name] for name in ("p50", "p99")}
    return {name: milliseconds(seconds) for name, seconds in (percentiles(track) | of_model).items()}


def _cost(cores: float, memory: float | None) -> dict[str, str]:
    return {"cores": f"{cores:.2f}", "MB": "-" if memory is None else f"{memory / 1e6:.0f}"}


def to_json(load_test: LoadTest, provenance: dict[str, object]) -> dict[str, object]:
    """Return the provenance, the settings, and the figures of the decisive run and of the search steps.

    Units are seconds, bytes, and shares from 0 to 1.
    """
    result = load_test.result
    plan = {item.name: getattr(result.plan, item.name) for item in fields(result.plan) if item.name != "settings"}
    plan |= {
        "video": Path(result.plan.video).name,
        "models": {name: file.name for name, file in plan["models"].items()},
    }
    return {
        **provenance,
        "settings": result.plan.settings.changed(),
        "plan": plan,
        "seconds": result.seconds,
        "interrupted": load_test.interrupted,
        "latency": {"track": percentiles(result.track), "model": percentiles(result.model)},
        "streams": [
            {
                **dict(zip(("cores", "memory"), result.cost(number), strict=True)),
                "frames": len(stream.due),
                "frames_per_second": result.rate(stream.skipped),
                "skipped": stream.skipped,
                "track": percentiles(stream.track),
                "model": percentiles(stream.model),
                **{name: stream.totals.get(name) for name in ("sent", "stored", "restarts")},
                "success": stream.success,
            }
            for number, stream in enumerate(result.streams)
        ],
        "processes": {
            name: {"cores": cores, "memory": result.memory.get(name)} for name, cores in result.cores.items()
        },
        "timeline": timeline(result),
        "subscribers": [
            {
                **{name: getattr(receipts, name) for name in ("stream", "channel", "received", "missed")},
                "latency": percentiles(receipts.latency),
            }
            for receipts in result.subscribers
        ],
        "camera_late": round(result.camera_late, 6),
        "limits": {limit.name: {"value": limit.value, "met": limit.is_met(result)} for limit in load_test.limits},
        "sustained": load_test.sustained,
        "verdict": verdict(load_test),
        "violations": violations(load_test.limits, result),
        "figures": _figures(result),
        "find": load_test.find,
        "highest": load_test.highest,
        "steps": [
            {
                **{name: getattr(step.plan, name) for name in SEARCHES},
                **_figures(step),
                "violations": violations(load_test.limits, step),
            }
            for step in load_test.results
        ],
        "refused": {str(number): reason for number, reason in load_test.refused.items()},
    }


def _figures(result: Result) -> dict[str, float]:
    """The figures of the worst stream, and the mean use of cores and memory of a stream."""
    return {**result.worst, **dict(zip(("cores", "memory"), result.mean_cost, strict=True))}


def write_report(path: Path, load_test: LoadTest, provenance: dict[str, object]) -> Path:
    """Write the report of the decisive run, and of the steps of a search."""
    result, over_time = load_test.result, timeline(load_test.result)
    has_chart = len(over_time["seconds"]) > 1
    verdicts = [(verdict(load_test), load_test.sustained is not False)]
    verdicts += [(error, False) for error in result.errors]
    verdicts += [(limit.describe(result), limit.is_met(result)) for limit in load_test.limits]
    return write_page(
        path,
        "loadtest.html",
        provenance=provenance,
        verdicts=verdicts,
        about=(
            f"{result.plan}, {result.seconds:.1f} s{', interrupted' * load_test.interrupted}. Latency counts from the "
            "due time of a frame, and ends for a skipped frame with the track of a newer one. The camera was at most "
            f"{milliseconds(result.camera_late)} ms late, and other processes of this machine kept "
            f"{result.other_load:.2f} cores busy."
        ),
        panels=[*panels(over_time, result.plan.rate * len(result.streams))] if has_chart else [],
        seconds=sum(over_time["seconds"][-1:] + over_time["seconds"][1:2]),  # the end of the last interval
        colours=COLOURS,
        tables=[*([_steps(load_test)] if load_test.find else []), *tables(result)],
        settings=result.plan.settings,
    )


def verdict(load_test: LoadTest) -> str:
    """Describe whether the load was sustained, or the highest sustained number and its costs."""
    result = load_test.result
    if load_test.find and load_test.highest:
        is_least = load_test.interrupted or load_test.highest == SEARCHES[load_test.find]
        start = "Interrupted" if load_test.interrupted else "Sustained"
        number = f"at {'least' if is_least else 'most'} {result.plan.number(load_test.find)}"
        cores, memory = result.mean_cost
        return f"{start}: {number}: {result.plan}; a stream takes {cores:.2f} cores, {memory / 1e6:.0f} MB."
    if load_test.interrupted:
        return f"Interrupted after {result.seconds:.1f} s: no verdict on {result.plan}."
    reasons = [limit.name for limit in load_test.limits if not limit.is_met(result)]
    reasons += ["a stream failed"] * bool(result.errors)
    return f"Not sustained ({', '.join(reasons)}): {result.plan}." if reasons else f"Sustained: {result.plan}."


def _steps(load_test: LoadTest) -> Table:
    rows = [
        {
            str(load_test.find): str(load_test.number(step)),
            "limits": "exceeded" if violations(load_test.limits, step) else "met",
            "tracked": f"{step.rate(step.worst['skipped']):.1f}",
            "skipped": f"{100 * step.worst['skipped']:.1f} %",
            **{f"{name} ms": milliseconds(step.worst[name]) for name in PERCENTILES},
            **_cost(*step.mean_cost),
        }
        for step in load_test.results
    ]
    refused = "".join(f" {number} did not start: {reason}." for number, reason in load_test.refused.items())
    note = f"The runs, in this order, with the figures of the worst stream; cores and MB are means.{refused}"
    return Table("Steps of the search", rows, note)
