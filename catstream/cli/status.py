"""`catstream status`: show the state of a running pipeline."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import click
from rich.table import Table

from catstream.cli.attach import with_endpoint
from catstream.cli.output import complain, screen, table
from catstream.client.registry import locate
from catstream.client.subscription import subscribe
from catstream.errors import SilenceError
from catstream.messages.kinds import Health
from catstream.messages.names import counted
from catstream.services.options import NumberRange, with_json
from catstream.wire.channels import CHANNELS

_NAMES = CHANNELS["health"].senders


@click.command()
@with_endpoint
@with_json
@click.option(
    "--wait",
    default=3.0,
    show_default=True,
    type=NumberRange(0),
    help="Maximum seconds to wait for health reports.",
)
def status(endpoint: str, keys: str, as_json: bool, wait: float) -> None:
    """Show the state of a running pipeline.

    The exit code is 0 if all three processes sent a health report, else 1, so
    that it can be the health check of a container.

    \b
    Prints
      state      tracking, paused, or waiting for a box
      frames     number of processed frames, and frames per second
      learning   messages that the compressor has not received, or not stored
      model      version of the model that the detector uses
      trees      size of the coreset trees
      source     whether a live source is available, and the number of skipped frames
      rejected   messages that do not conform to the protocol
      trouble    a problem of a process, if there is one
      reports    each process, and the age of its last health report
      objects    if they have names: the state, score, model and leaves of each

    \b
    EXAMPLES
      catstream status
      catstream status --endpoint run --json
    """
    place, reports = _collect_reports(endpoint, keys, wait)
    summary = _summary(place, reports)
    silent = [name for name in _NAMES if name not in reports]
    if as_json:
        click.echo(json.dumps(summary))
    elif reports:
        click.echo(_format(summary))
        if any(summary["objects"]):  # they have names
            click.echo()
            screen().print(_table(summary["objects"]))
    if silent:
        if not reports:
            locate(endpoint, keys)  # its error says why a stream of a fleet does not run
        complain(f"no health report at {place} within {wait:g} s from: {', '.join(silent)}")
        sys.exit(1)


def _collect_reports(endpoint: str, keys: str, seconds: float) -> tuple[str, dict[str, list[Health]]]:
    """Collect reports, oldest first, until there are two of the detector, for its rate, and one of the others."""
    deadline = time.monotonic() + seconds
    reports: dict[str, list[Health]] = {}
    with subscribe(endpoint, "health", keys=keys) as health:
        while len(reports) < len(_NAMES) or len(reports["detector"]) < 2:
            health.timeout = max(0.0, deadline - time.monotonic())
            try:
                report = next(health, None)
            except SilenceError:
                break
            if report is None:  # the pipeline has just ended
                break
            reports.setdefault(report.process, []).append(report)
        return health.endpoint, reports


def _summary(place: str, reports: dict[str, list[Health]]) -> dict[str, Any]:
    """Return the figures from the reports, None for those that are missing."""
    counters = {name: reports[name][-1].counters if name in reports else {} for name in _NAMES}
    detector, compressor = counters["detector"], counters["compressor"]

    def behind(name: str) -> int | None:
        return int(detector["sent"] - detector[name]) if detector else None

    def whole(counters: dict[str, float], name: str) -> int | None:
        return int(counters[name]) if name in counters else None

    return {
        "endpoint": place,
        "ok": len(reports) == len(_NAMES),
        "state": _state(detector),
        "objects": _objects(reports),
        "frames": whole(detector, "sent"),
        "frames_per_second": _rate(reports.get("detector", [])),
        "lag": behind("taken"),
        "not_stored": behind("stored"),
        "model_version": whole(detector, "model_version"),
        "level": whole(compressor, "level"),
        "leaves": whole(compressor, "leaves"),
        "nodes": whole(compressor, "nodes"),
        "bytes": whole(compressor, "bytes"),
        "skipped": whole(detector, "skipped"),
        "reopened": whole(detector, "reopened"),
        "lost_seconds": detector.get("lost_seconds"),
        "trouble": {name: history[-1].trouble for name, history in reports.items() if history[-1].trouble},
        "rejected": {name: int(counters[name].get("rejected", 0)) for name in reports},
        "processes": {
            name: {"seconds_ago": round(max(0.0, time.time() - history[-1].time), 2), "counters": history[-1].counters}
            for name, history in reports.items()
        },
    }


def _state(detector: dict[str, float]) -> str | None:
    if not detector:
        return None
    return "waiting for a box" if detector.get("waiting") else "paused" if detector.get("paused") else "tracking"


def _objects(reports: dict[str, list[Health]]) -> dict[str, dict[str, Any]]:
    """The figures of each object by name, None for those that are missing."""
    tracked, learned = (reports[name][-1].objects if name in reports else {} for name in ("detector", "compressor"))
    return {
        name: {
            "state": "present" if counters["present"] else "absent",
            "score": round(counters["score"], 2),
            "model_version": int(counters["model_version"]),
            "leaves": int(learned[name]["leaves"]) if name in learned else None,
        }
        for name, counters in tracked.items()
    }


def _rate(history: list[Health]) -> float | None:
    """Return the frames per second between the first and the last report of the detector."""
    if len(history) < 2 or history[-1].time <= history[0].time:
        return None
    frames = history[-1].counters["sent"] - history[0].counters["sent"]
    # The counter of a restarted detector decreases.
    return round(max(0.0, frames) / (history[-1].time - history[0].time), 1)


def _format(summary: dict[str, Any]) -> str:
    def shown(name: str) -> str:
        return "-" if summary[name] is None else f"{summary[name]}"

    history = (f"{name} {of['seconds_ago']:.1f} s ago" for name, of in summary["processes"].items())
    lost = f"lost for {summary['lost_seconds']:.0f} s" if summary["lost_seconds"] else "available"
    source = f"source     {lost}, {counted(summary['skipped'] or 0, 'frame')} skipped"
    if summary["reopened"] is not None:  # a demo is never lost
        source += f", reopened {counted(summary['reopened'], 'time')}"
    size = (summary["bytes"] or 0) / 1e6
    trees = f"trees      {shown('leaves')} leaves, {shown('nodes')} nodes, level {shown('level')}, {size:.1f} MB"
    return "\n".join(
        (
            f"pipeline   {summary['endpoint']}",
            f"state      {shown('state')}",
            f"frames     {shown('frames')}, {shown('frames_per_second')} a second",
            f"learning   {shown('lag')} messages behind, {shown('not_stored')} not stored",
            f"model      {shown('model_version')}",
            *([trees] if summary["bytes"] is not None else []),  # None before the first box
            *([source] if summary["skipped"] is not None else []),  # None for a file
            f"rejected   {counted(sum(summary['rejected'].values()), 'message')}",
            f"reports    {', '.join(history)}",
            *(f"trouble    {name}: {trouble}" for name, trouble in summary["trouble"].items()),
        )
    )


def _table(objects: dict[str, dict[str, Any]]) -> Table:
    figures = ("state", "score", "model", "leaves")
    shown = table("object", *figures, right=figures)
    for name, each in objects.items():
        shown.add_row(name or "-", *("-" if cell is None else str(cell) for cell in each.values()))
    return shown
