"""`catstream status`: how a running pipeline is."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import click

from catstream.cli.attach import with_endpoint
from catstream.errors import SilenceError
from catstream.messages import Health
from catstream.subscription import subscribe
from catstream.wire.channels import CHANNELS

__all__ = ["status"]

_NAMES = CHANNELS["health"].senders


@click.command()
@with_endpoint
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@click.option("--wait", default=3.0, show_default=True, type=click.FloatRange(0), help="Seconds to listen at most.")
def status(endpoint: str, keys: str, as_json: bool, wait: float) -> None:
    """Ask a running pipeline how it is.

    Exits with 0 where all three processes were heard, and with 1 otherwise: a
    health check of a container, or of a timer.

    \b
    Prints
      state      following, paused, or waiting for a box
      frames     how many were followed, and how many a second now
      learning   messages that the compressor has not taken yet, or not stored
      model      the version that the detector uses
      trees      the coreset trees of the compressor
      source     whether a camera or a stream is there, and the frames skipped
      rejected   messages that were not what their channel carries
      trouble    what is wrong with a process, where something is
      heard      each process, and how long ago it said so

    \b
    EXAMPLES
      catstream status
      catstream status --endpoint run --json
    """
    place, reports = _listen(endpoint, keys, wait)
    found = _summary(place, reports)
    silent = [name for name in _NAMES if name not in reports]
    if as_json:
        click.echo(json.dumps(found))
    elif reports:
        click.echo(_text(found))
    if silent:
        click.echo(f"catstream: not heard at {place} within {wait:g} s: {', '.join(silent)}", err=True)
        sys.exit(1)


def _listen(endpoint: str, keys: str, seconds: float) -> tuple[str, dict[str, list[Health]]]:
    """What each process said, oldest first, until all were heard and the detector twice: that gives its rate."""
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
    """What was heard, in figures; None for what was not."""
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
        "trouble": {name: heard[-1].trouble for name, heard in reports.items() if heard[-1].trouble},
        "rejected": {name: int(counters[name].get("rejected", 0)) for name in reports},
        "processes": {
            name: {"seconds_ago": round(max(0.0, time.time() - heard[-1].time), 2), "counters": heard[-1].counters}
            for name, heard in reports.items()
        },
    }


def _state(detector: dict[str, float]) -> str | None:
    if not detector:
        return None
    return "waiting for a box" if detector.get("waiting") else "paused" if detector.get("paused") else "following"


def _rate(heard: list[Health]) -> float | None:
    """Frames a second between the first and the last of a detector's reports."""
    if len(heard) < 2 or heard[-1].time <= heard[0].time:
        return None
    frames = heard[-1].counters["sent"] - heard[0].counters["sent"]
    return round(max(0.0, frames) / (heard[-1].time - heard[0].time), 1)  # a restarted detector goes back


def _text(found: dict[str, Any]) -> str:
    def shown(name: str) -> str:
        return "-" if found[name] is None else f"{found[name]}"

    heard = (f"{name} {of['seconds_ago']:.1f} s ago" for name, of in found["processes"].items())
    size = "-" if found["bytes"] is None else f"{found['bytes'] / 1e6:.1f}"
    lost = f"lost for {found['lost_seconds']:.0f} s" if found["lost_seconds"] else "there"
    source = f"source     {lost}, {shown('skipped')} frames skipped, came back {shown('reopened')} times"
    return "\n".join(
        (
            f"pipeline   {found['endpoint']}",
            f"state      {shown('state')}",
            f"frames     {shown('frames')}, {shown('frames_per_second')} a second",
            f"learning   {shown('lag')} messages behind, {shown('not_stored')} not stored",
            f"model      {shown('model_version')}",
            f"trees      {shown('leaves')} leaves, {shown('nodes')} nodes, level {shown('level')}, {size} MB",
            *([source] if found["skipped"] is not None else []),  # a file skips none
            f"rejected   {sum(found['rejected'].values())} messages",
            f"heard      {', '.join(heard)}",
            *(f"trouble    {name}: {trouble}" for name, trouble in found["trouble"].items()),
        )
    )
