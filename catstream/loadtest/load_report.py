"""The results of a load test: tables of text, an HTML file, and JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from catstream.base.arrays import Float64
from catstream.base.text import counted
from catstream.loadtest.latency import PERCENTILES, percentiles
from catstream.loadtest.load_test import KINDS, MOST_STREAMS, LoadTest, Result, violations
from catstream.reports.provenance import provenance
from catstream.reports.report import write_page

_SUSTAINED = 0.01  # share of skipped frames up to which a rate counts as sustained


class Table(NamedTuple):
    """A table of text: its title, rows of cells by the heads of their columns, and an explanation of the columns."""

    title: str
    rows: list[dict[str, str]]
    note: str = ""

    @property
    def heads(self) -> list[str]:
        return list(self.rows[0])

    @property
    def cells(self) -> list[list[str]]:
        return [[row.get(head, "") for head in self.heads] for row in self.rows]

    @property
    def means(self) -> int:
        """Number of the last rows that are means of the others."""
        return int(self.cells[-1][0] == "all")


def tables(result: Result) -> Iterator[Table]:
    """Yield the tables of a run: streams, processes and, if there were any, subscribers."""
    together = [{"stream": "all", **_latencies(result.track, result.model)}] if len(result.streams) > 1 else []
    streams = [
        {
            "stream": str(number),
            "frames/s": f"{stream.rate(result.plan.rate):.1f}",
            "skipped": f"{100 * stream.skipped_share:.1f} %",
            "cores": f"{result.cores(number):.2f}",
            "MB": f"{result.stream_memory(number) / 1e6:.0f}",
            **_latencies(stream.track, stream.model),
            "lag": str(stream.max_lag),
            "not stored": _cell(stream.not_stored, "d"),
            "success": _cell(stream.success, ".3f"),
            "of tracked": _cell(stream.success_followed, ".3f"),
        }
        for number, stream in enumerate(result.streams)
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


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def to_json(load_test: LoadTest) -> dict[str, object]:
    """Return the figures of the decisive run, those of the search steps, and the provenance.

    Units are seconds, bytes, and shares from 0 to 1.
    """
    result = load_test.result
    plan = {item.name: getattr(result.plan, item.name) for item in fields(result.plan) if item.name != "settings"}
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
        "highest_streams": load_test.highest,
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
        "refused": {str(streams): reason for streams, reason in load_test.refused.items()},
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
    """Write the report of the decisive run, and of the steps of a search."""
    result = load_test.result
    verdicts = [(f"{answer(load_test)}.", load_test.highest is not None) if load_test.find else _verdict(result)]
    verdicts += [(error, False) for error in result.errors]
    verdicts += [(limit.describe(result), limit.is_met(result)) for limit in load_test.limits]
    return write_page(
        path,
        "loadtest.html",
        verdicts=verdicts,
        about=(
            f"{result.plan}, {result.seconds:.1f} s{', interrupted' * load_test.interrupted}. Latency counts from the "
            "due time of a frame; that of a skipped frame ends with the track of a newer one. The camera was at most "
            f"{milliseconds(result.camera_late)} ms late, and other processes of this machine kept "
            f"{result.other_load:.2f} cores busy."
        ),
        tables=[*([_steps(load_test)] if load_test.find else []), *tables(result)],
        settings=result.plan.settings,
    )


def _verdict(result: Result) -> tuple[str, bool]:
    """A sentence: every stream was tracked at its rate, or where and when most frames were skipped."""
    worst, measures = max(enumerate(result.streams), key=lambda stream: stream[1].skipped_share)
    rate = f"{counted(len(result.streams), 'stream')} of {result.plan.rate:g} frames/s"
    skipped = f"{100 * measures.skipped_share:.1f} %"
    if measures.skipped_share <= _SUSTAINED:
        return f"Sustained: {rate}, at most {skipped} of the frames skipped.", True
    since = measures.due[~measures.followed][0] - measures.due[0]
    return (
        f"Not sustained: of {rate}, stream {worst} skipped {skipped} of its frames, the first after {since:.1f} s: it "
        f"was tracked at {measures.rate(result.plan.rate):.1f} frames/s."
    ), False


def answer(load_test: LoadTest) -> str:
    """How many streams this machine serves, and what a stream costs."""
    if load_test.highest is None:
        return "Interrupted: no answer yet" if load_test.interrupted else "No number of streams meets the limits"
    (cores, memory), most = load_test.result.cost, "at least " * (load_test.highest == MOST_STREAMS)
    return (
        f"This machine serves {most}{load_test.result.plan}; a stream takes {cores:.2f} cores and {memory / 1e6:.0f} MB"
    )


def _steps(load_test: LoadTest) -> Table:
    rows = [
        {
            "streams": f"{step.plan.streams}",
            "limits": "exceeded" if violations(load_test.limits, step) else "met",
            "tracked": f"{step.followed:.1f}",
            "skipped": f"{100 * KINDS['skipped'].measure(step):.1f} %",
            **{f"{name} ms": milliseconds(KINDS[name].measure(step)) for name in PERCENTILES},
            "cores a stream": f"{step.cost[0]:.2f}",
            "MB a stream": f"{step.cost[1] / 1e6:.0f}",
        }
        for step in load_test.results
    ]
    refused = "".join(f" {streams} streams did not start: {reason}." for streams, reason in load_test.refused.items())
    note = f"The runs, in this order, with the figures of the worst stream; cores and MB are means.{refused}"
    return Table("Steps of the search", rows, note)
