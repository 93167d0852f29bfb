"""`catstream loadtest`: the latency and the losses of pipelines under load, and a verdict as exit status."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.progress import BarColumn

from catstream.cli.common import (
    line_of,
    messages,
    screen,
    stopped,
    table,
    text,
    with_json_file,
    with_raw_file,
    with_report_file,
    write_json,
)
from catstream.cli.options import PATH, NumberRange, with_object, with_settings
from catstream.errors import BoxError, CatstreamError, ObjectError, SettingsError, VideoError

if TYPE_CHECKING:
    from catstream.measure.load_result import Limit, Plan, Result

_QUIET_CORES = 0.25  # load by other processes above which a warning is printed


def _size(_: click.Context, __: click.Parameter, text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    if not match or min(size := (int(match[1]), int(match[2]))) < 64:
        raise click.BadParameter(f"a size is WIDTHxHEIGHT, 64x64 to 9999x9999, got {text!r}: for example 640x480")
    return size


class _LoadTest(click.Group):
    """Exits with 2 if the arguments are invalid, because 1 states that the load was not sustained."""

    def make_context(self, *arguments: Any, **options: Any) -> click.Context:
        try:
            return super().make_context(*arguments, **options)
        except CatstreamError as error:
            raise click.UsageError(str(error)) from None

    def invoke(self, context: click.Context) -> Any:
        try:
            return super().invoke(context)
        except (SettingsError, BoxError, ObjectError, VideoError) as error:
            raise click.UsageError(str(error)) from None


@click.group(cls=_LoadTest, invoke_without_command=True)
@click.option("--streams", type=click.IntRange(1, 64), default=1, show_default=True, help="Number of pipelines.")
@click.option(
    "--video", default="", metavar="FILE", help="Recording to send over and over; by default a rendered video."
)
@with_object
@click.option("--objects", type=click.IntRange(1, 16), help="Objects in the rendered video.  [default: 1]")
@click.option(
    "--subscribers", type=click.IntRange(0, 1000), default=0, show_default=True, help="Subscribers to each pipeline."
)
@click.option(
    "--channel",
    "channels",
    type=click.Choice(["tracks", "models", "samples", "previews", "features"]),
    multiple=True,
    default=["tracks"],
    show_default=True,
    help="Channel of the subscribers; repeatable.",
)
@click.option("--slow-subscribers", type=click.IntRange(0), default=0, help="Number of slow subscribers among them.")
@click.option(
    "--rate",
    type=NumberRange(0.5, 1000),
    help="Frames per second of each stream.  [default: the rate of the recording, or 25]",
)
@click.option("--duration", type=NumberRange(1, 86400), default=10.0, show_default=True, help="Duration in seconds.")
@click.option("--size", callback=_size, metavar="WxH", help="Size of the rendered video.  [default: 640x480]")
@click.option(
    "--source", type=click.Choice(["mjpeg", "h264"]), default="mjpeg", show_default=True, help="Over HTTP or RTSP."
)
@click.option("--warm-up", is_flag=True, help="Measure the training of the first models as well.")
@click.option(
    "--find",
    type=click.Choice(["streams", "rate", "subscribers"]),
    help="Search for the highest number within the limits.",
)
@click.option("--limit", "limits", multiple=True, metavar="NAME=VALUE", help="Limit to meet, see above; repeatable.")
@with_json_file
@with_raw_file
@with_report_file
@with_settings
def loadtest(
    find: str | None,
    limits: tuple[str, ...],
    json_file: Path | None,
    raw_file: Path | None,
    report_file: Path | None,
    **options: Any,
) -> None:
    """Measure latency and dropped frames of pipelines under load.

    The load test sends a rendered video with ground truth, or the recording
    --video with its objects --box and --model, as a network camera does, on the
    loopback interface; a pipeline of its own tracks each stream.
    The camera does not wait: frame i is due at start + i / RATE, and latency
    counts from then. The latency of a skipped frame ends with the track of a
    newer one. Slow subscribers read two tracks per second.

    \b
    LIMITS, of the worst stream (0.1 or 100ms, 0.01 or 1%)
      p50 p95 p99 p99.9 max     seconds from a frame to its track, at most
      model-p50 ... model-max   seconds from a frame to the model trained on it, at most
      skipped                   share of frames that were not tracked, at most
      subscriber-p50 ... -max   seconds from a frame to its receipt by fast subscribers, at most
      subscriber-missed         share of frames that fast subscribers missed, at most
      success                   share of frames with an IoU above 0.5 with the ground truth,
                                or with an unloaded run of the recording, at least

    Without --limit, the limits are p99=0.1 and skipped=0, or skipped=0.01 with
    --warm-up. The last line is the verdict. The exit status is 0 if the load was
    sustained (no stream failed, and all limits are met), 1 if it was not, and 2
    if the arguments are invalid. With --find, the load test searches for the
    highest number that is sustained in two runs, starting with the given one; for
    subscribers, the default limits include subscriber-p99=0.1 and subscriber-missed=0.

    \b
    EXAMPLES
      catstream loadtest --rate 30 --limit p99=100ms
      catstream loadtest --objects 8 --limit skipped=0.01
      catstream loadtest --video recording.mp4 --box 120,80,64,48 --limit success=0.95
      catstream loadtest --subscribers 500 --limit subscriber-p99=0.05 --report load.html
      catstream loadtest --find streams --rate 25 --size 1920x1080
    """
    if click.get_current_context().invoked_subcommand is not None:
        return
    from catstream.measure.load_report import milliseconds, to_json, verdict, write_raw, write_report
    from catstream.measure.load_result import Limit, violations
    from catstream.measure.load_test import run_load_test
    from catstream.measure.provenance import provenance

    parameters = _plan(**options)
    parsed = [*map(Limit.parse, limits)] or Limit.defaults(parameters, find)
    with line_of(
        messages(), text("{task.description}"), BarColumn(24), text("{task.fields[figures]}", last=True)
    ) as progress:
        task = progress.add_task("starting", total=1.0, figures="")

        def report(activity: str, share: float, figures: str) -> None:
            progress.update(task, description=activity, completed=share, figures=figures)

        def done(result: Result) -> None:
            if find:
                (cores, memory), verdict = result.mean_cost, "; ".join(violations(parsed, result)) or "met"
                click.echo(
                    f"{result.plan.number(find)}: in the worst stream, {result.rate(result.worst['skipped']):.1f} "
                    f"frames/s tracked, p99 {milliseconds(result.worst['p99'])} ms; each takes {cores:.2f} cores, "
                    f"{memory / 1e6:.0f} MB: {verdict}"
                )

        load_test = run_load_test(parameters, parsed, find=find, report=report, done=done)
    for number, reason in load_test.refused.items():
        click.echo(f"{number} did not start: {reason}")
    if load_test.results:
        origin = provenance(["catstream", *sys.argv[1:]])
        _print_run(load_test.result, parsed)
        write_json(json_file, to_json(load_test, origin))
        if raw_file is not None:
            write_raw(raw_file, load_test.result)
        if report_file is not None:
            click.echo(f"report: {write_report(report_file, load_test, origin)}")
        click.echo(verdict(load_test))
    if load_test.interrupted:
        stopped("these are the results so far" if load_test.results else "there are no measurements yet")
    sys.exit(0 if load_test.sustained else 1)


def _plan(video: str, size: tuple[int, int] | None, objects: int | None, rate: float | None, **options: Any) -> Plan:
    from catstream.measure.load_result import Plan
    from catstream.measure.load_video import with_recording

    if video and (size or objects):
        raise SettingsError("a recording has its own size and objects: omit --size and --objects, or --video")
    if video:
        return with_recording(Plan(video=video, **options), rate)
    if options["boxes"] or options["models"]:
        raise SettingsError("--box and --model are objects of a recording: pass --video FILE as well")
    return Plan(size=size or (640, 480), objects=objects or 1, rate=rate or 25.0, **options)


def _print_run(result: Result, limits: list[Limit]) -> None:
    from catstream.measure.load_report import milliseconds, tables

    click.echo(
        f"{result.plan}, {result.seconds:.1f} s; latencies in ms; the camera was at most "
        f"{milliseconds(result.camera_late)} ms late"
    )
    for part in tables(result):
        output = table(*part.headers, right=part.headers[1:])
        for row in part.cells:
            output.add_row(*row)
        screen().print(output)
    if result.other_load > _QUIET_CORES:
        click.echo(
            f"other processes kept {result.other_load:.1f} cores busy: repeat on an idle machine for reliable results"
        )
    for error in result.errors:
        click.echo(f"{click.style('failed', 'red')}: {error}")
    for limit in limits:
        met = click.style("met", "green") if limit.is_met(result) else click.style("not met", "red")
        click.echo(f"{met}: {limit.describe(result)}")


def _tolerance(_: click.Context, __: click.Parameter, text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?%", text)
    if not match:
        raise click.BadParameter(f"a tolerance is a percentage, got {text!r}: for example 10%")
    return float(match[1]) / 100


@loadtest.command()
@click.argument("before", type=PATH)
@click.argument("after", type=PATH)
@click.option(
    "--tolerance", default="10%", show_default=True, callback=_tolerance, help="Share by which a figure may be worse."
)
def compare(before: Path, after: Path, tolerance: float) -> None:
    """Compare two results of `catstream loadtest --json`.

    The exit status is 1 if a figure of AFTER is worse than in BEFORE by more than
    the tolerance, 2 if the results have different plans, and 0 otherwise. Of two
    searches, the numbers that they have found are compared. p99.9 and max are
    only shown: they are the latencies of single frames.

    \b
    EXAMPLES
      catstream loadtest --json before.json
      catstream loadtest --json after.json
      catstream loadtest compare before.json after.json --tolerance 20%
    """
    from catstream.measure.load_compare import compare, read_result
    from catstream.measure.load_report import figure

    changes = compare(read_result(before), read_result(after), tolerance)
    output = table("figure", "before", "after", "worse by", "", right=("before", "after", "worse by"))
    for name, *values, worse, is_regression in changes:
        share = "-" if not worse else f"{100 * worse:+.1f} %"
        output.add_row(name, *(figure(name, value) for value in values), share, "regression" * is_regression)
    screen().print(output)
    worst = [change.name for change in changes if change.is_regression]
    click.echo(
        f"Regression: {', '.join(worst)}." if worst else f"No figure is worse by more than {100 * tolerance:g} %."
    )
    sys.exit(1 if worst else 0)
