"""`catstream loadtest`: measure pipelines under load."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from catstream.cli.files import with_json_file, write_json
from catstream.cli.interrupts import stopped
from catstream.cli.output import complain, line_of, messages, screen, table
from catstream.messages.storage import writing
from catstream.services.options import FOLDER, NumberRange, with_settings

if TYPE_CHECKING:
    from catstream.applications.loadtest.limits import Limit
    from catstream.applications.loadtest.run import Result

_FAILED = 1  # exit code if a limit was not met or a stream failed
_QUIET_CORES = 0.25  # load by other processes above which a warning is printed
_FIND = ("p99=0.1", "skipped=0.01")  # limits of a search if none are given


def _size(_: click.Context, __: click.Parameter, text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    if not found or min(size := (int(found[1]), int(found[2]))) < 64:
        raise click.BadParameter(f"a size is WIDTHxHEIGHT, 64x64 to 9999x9999, got {text!r}: for example 640x480")
    return size


@click.command()
@click.option("--streams", type=click.IntRange(1, 64), default=1, show_default=True, help="Number of pipelines.")
@click.option("--objects", type=click.IntRange(1, 16), default=1, show_default=True, help="Objects of each pipeline.")
@click.option(
    "--subscribers", type=click.IntRange(0, 1000), default=0, show_default=True, help="Subscribers to each pipeline."
)
@click.option("--slow-subscribers", type=click.IntRange(0), default=0, help="How many of them are slow or frozen.")
@click.option(
    "--rate",
    type=NumberRange(0.5, 1000),
    default=25.0,
    show_default=True,
    help="Frames per second of each stream.",
)
@click.option("--duration", type=NumberRange(1, 86400), default=10.0, show_default=True, help="Seconds.")
@click.option(
    "--size", default="640x480", show_default=True, callback=_size, metavar="WxH", help="Size of a frame in pixels."
)
@click.option("--find-limit", is_flag=True, help="Search for the highest rate that meets the limits.")
@click.option(
    "--limit", "limits", multiple=True, metavar="NAME=VALUE", help="A limit to meet; may be repeated; see above."
)
@with_json_file
@click.option("--output", type=FOLDER, help="Folder for report.html.")
@with_settings
def loadtest(
    find_limit: bool,
    limits: tuple[str, ...],
    json_file: Path | None,
    output: Path | None,
    **plan: Any,
) -> None:
    """Run pipelines under load, and measure latency and losses.

    The load test sends a rendered video with ground truth over HTTP on the
    loopback interface; a pipeline of its own tracks each stream. The camera
    does not wait: frame i is due at start + i / RATE, and latency counts from
    then. The latency of a skipped frame ends with the track of a newer one.
    With several objects, it is the video of `catstream demo --objects N`;
    success and latencies are those of the first object.

    Slow subscribers read two tracks per second; half of them are frozen
    instead.

    \b
    LIMITS, of the worst stream
      p50 p95 p99 p99.9 max     seconds from a frame to its track, at most
      model-p50 ... model-max   seconds from a frame to the model trained on it, at most
      skipped                   share of frames that were not tracked, at most
      missed                    share of frames whose tracks fast subscribers missed, at most
      success                   share of frames with an overlap above 0.5, at least

    With --find-limit, the search begins with RATE, each rate runs for DURATION,
    and the limits are p99=0.1 and skipped=0.01 if none are given.

    With --output, OUTPUT/report.html has all figures and plots.

    The exit code is 0; 1 if a limit was not met or a stream failed; 130 after
    Ctrl-C, which ends all processes and prints the measurements so far.

    \b
    EXAMPLES
      catstream loadtest --rate 30 --limit p99=0.1
      catstream loadtest --objects 8 --limit skipped=0.01
      catstream loadtest --streams 4 --subscribers 50 --slow-subscribers 5 --output load
      catstream loadtest --find-limit --size 320x240
    """
    # Imported here so that --help and the other commands start faster.
    from catstream.applications.loadtest.limits import Limit, violations
    from catstream.applications.loadtest.load_test import run_load_test
    from catstream.applications.loadtest.measures import percentiles
    from catstream.applications.loadtest.plan import Plan
    from catstream.applications.loadtest.report import milliseconds, to_json, write_report

    asked = [Limit.parse(text) for text in limits or (_FIND if find_limit else ())]
    parameters = Plan(**plan)
    if output is not None:
        with writing(output):
            output.mkdir(parents=True, exist_ok=True)
    with line_of(messages(), lambda task: [task.description, task.fields["figures"]]) as progress:
        task = progress.add_task("starting", total=1.0, figures="")

        def report(activity: str, share: float, figures: str) -> None:
            progress.update(task, description=activity, completed=share, figures=figures)

        def done(result: Result) -> None:
            if find_limit:
                verdict = "; ".join(violations(asked, result)) or "met"
                click.echo(
                    f"{result.plan.rate:g} frames/s due, {result.followed:.1f} tracked, "
                    f"p99 {milliseconds(percentiles(result.track)['p99'])} ms: {verdict}"
                )

        load_test = run_load_test(parameters, asked, find=find_limit, report=report, done=done)
    if load_test.results:
        _print(load_test.result, asked)
        write_json(json_file, to_json(load_test))
        if output is not None:
            click.echo(f"report: {write_report(output / 'report.html', load_test)}")
    if load_test.interrupted:
        stopped("these are the figures so far" if load_test.results else "there are no measurements yet")
    if load_test.highest_rate:
        click.echo(
            f"the highest rate that meets {', '.join(map(str, asked))}: {load_test.highest_rate:g} frames/s a stream"
        )
    for line in load_test.violations:
        complain(f"broken: {line}")
    if load_test.violations:
        sys.exit(_FAILED)


def _print(result: Result, limits: list[Limit]) -> None:
    from catstream.applications.loadtest.report import milliseconds, tables

    click.echo(
        f"{result.plan}, {result.seconds:.1f} s; latencies in ms; the camera was at most "
        f"{milliseconds(result.camera_late)} ms late",
    )
    for each in tables(result):
        heads = list(each.rows[0])
        made = table(*heads, right=heads[1:])
        for row in each.cells():
            made.add_row(*row)
        screen().print(made)
    if result.other_load > _QUIET_CORES:
        click.echo(
            f"other processes kept {result.other_load:.1f} cores busy: run it on a quiet machine for reliable figures"
        )
    for limit in limits:
        if limit.is_met(result):  # the others are an error
            click.echo(f"{click.style('met', 'green')}: {limit.describe(result)}")
