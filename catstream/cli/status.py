"""`catstream status`: the state of a running pipeline, from the health reports of its processes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import suppress

import click
import msgspec

from catstream.base.clock import STEP_SECONDS, RunningClock
from catstream.base.text import counted
from catstream.cli.attach import with_address
from catstream.cli.common import complain, screen, table
from catstream.cli.options import NumberRange, with_json
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.errors import SilenceError
from catstream.wire.channels import CHANNELS
from catstream.wire.messages import Health, RunState, run_state

_PROCESSES = CHANNELS["health"].senders


class Status(msgspec.Struct):
    """The state of a pipeline.

    endpoint           of the pipeline
    ok                 whether each process has sent a report
    state              of the run; None without a report of the detector
    frames_per_second  between the reports of the detector; None without two of them
    processes          the newest report of each process, by name
    """

    endpoint: str
    ok: bool = False
    state: RunState | None = None
    frames_per_second: float | None = None
    processes: dict[str, Health] = {}

    def add(self, report: Health) -> None:
        """Add a report, in the order of arrival."""
        if report.process == "detector":
            self.state = report.state
            if (before := self.processes.get("detector")) is not None and report.time > before.time:
                frames = report.counters["sent"] - before.counters["sent"]  # less than 0 after a restart
                self.frames_per_second = round(max(0.0, frames / (report.time - before.time)), 1)
        self.processes[report.process] = report
        self.ok = len(self.processes) == len(_PROCESSES)

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield the name and the text of each line."""
        yield "pipeline", self.endpoint
        if "detector" in self.processes:
            counters = self.processes["detector"].counters
            rate = "" if self.frames_per_second is None else f", {self.frames_per_second} a second"
            yield "state", run_state(counters)[1]
            yield "frames", f"{counters['sent']:.0f}{rate}"
            behind, not_stored = (counters["sent"] - counters[name] for name in ("processed", "stored"))
            yield "learning", f"{counted(behind, 'message')} behind, {not_stored:.0f} not stored"
            yield "model", f"{counters['model_version']:.0f}"
            if "skipped" in counters:  # not of a file
                reconnects = "reconnects" in counters and f", {counted(int(counters['reconnects']), 'reconnect')}"
                yield "source", f"{counted(int(counters['skipped']), 'frame')} skipped{reconnects or ''}"
            if not_written := counters.get("not_written"):
                yield "results", f"{counted(int(not_written), 'frame')} not written"
        if "compressor" in self.processes and "bytes" in (trees := self.processes["compressor"].counters):
            size = f"{trees['bytes'] / 1e6:.1f} MB"  # without trees before the first box
            yield (
                "trees",
                f"{trees['leaves']:.0f} leaves, {trees['nodes']:.0f} nodes, level {trees['level']:.0f}, {size}",
            )
        reports, now = self.processes.values(), time.time()
        yield "rejected", f"{sum(report.counters.get('rejected', 0) for report in reports):.0f} messages or connections"
        yield "reports", ", ".join(f"{report.process} {max(0.0, now - report.time):.1f} s ago" for report in reports)
        if trouble := [f"{report.process}: {report.trouble}" for report in reports if report.trouble]:
            yield "trouble", "; ".join(trouble)


@click.command()
@with_address
@with_json
@click.option(
    "--wait", default=3.0, show_default=True, type=NumberRange(0), help="Maximum seconds to wait for health reports."
)
def status(address: Address, as_json: bool, wait: float) -> None:
    """Show the state of a running pipeline.

    The state is running, waiting (for a box), paused, or lost (the source). The
    exit status is 0 if all three processes sent a health report, else 1, so that
    the command can be the health check of a container.

    "learning" is the backlog: messages that the compressor has not received or
    not stored; "rejected" counts invalid messages and refused connections;
    "reports" is the age of the last health report of each process.

    \b
    EXAMPLES
      catstream status
      catstream status --endpoint run --json
    """
    address = address.with_endpoint()
    pipeline = _collect(address, wait)
    if as_json:
        click.echo(msgspec.json.encode(pipeline))
    elif pipeline.processes:
        click.echo("\n".join(f"{name:10} {line}" for name, line in pipeline.lines()))
        _print_objects(pipeline)
    if not pipeline.ok:
        problem = "" if pipeline.processes else f": {address.resolve().hint()}"
        silent = ", ".join(name for name in _PROCESSES if name not in pipeline.processes)
        complain(f"no health report at {address} within {wait:g} s from: {silent}{problem}")
        sys.exit(1)


def _collect(address: Address, seconds: float) -> Status:
    """Collect reports until there are two of the detector, for its rate, and one of each other process."""
    clock, pipeline = RunningClock(), Status(str(address))
    with subscribe(address, "health") as health:
        while not pipeline.ok or pipeline.frames_per_second is None:
            if (remaining := seconds - clock()) <= 0:
                break
            health.timeout = min(remaining, STEP_SECONDS)
            with suppress(SilenceError):
                if (report := next(health, None)) is None:
                    break
                pipeline.add(report)
    return pipeline


def _print_objects(pipeline: Status) -> None:
    """Print a table of the objects, if they have names."""
    by_process = {name: report.objects for name, report in pipeline.processes.items()}
    objects, trees = by_process.get("detector", {}), by_process.get("compressor", {})
    if not any(objects):
        return
    figures = ("state", "score", "model", "leaves")
    rows = table("object", *figures, right=figures)
    for name, counters in objects.items():
        state = {None: "-", 0.0: "absent", 1.0: "present"}[counters.get("present")]
        score = f"{counters['score']:.2f}" if "score" in counters else "-"
        leaves = f"{trees[name]['leaves']:.0f}" if name in trees else "-"
        rows.add_row(name or "-", state, score, f"{counters['model_version']:.0f}", leaves)
    screen().print("", rows, sep="\n")
