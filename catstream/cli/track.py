"""`catstream track`: track objects in a video."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.text import listed
from catstream.cli.common import INTERRUPTS, messages, stopped
from catstream.cli.options import (
    FOLDER,
    PATH,
    combined,
    with_files,
    with_object,
    with_overrides,
    with_overwrite,
    with_part,
    with_reading,
)
from catstream.cli.progress import REFRESH_SECONDS, RunProgress
from catstream.cli.view import HostPort, server_of, with_view
from catstream.client.address import Address
from catstream.output.destinations import (
    SINKS,
    STDOUT,
    Origin,
    SinkOptions,
    TrackedFrame,
    check_result,
    is_file,
    kind_of,
    redacted,
)
from catstream.output.options import parse_rotation
from catstream.output.track_log import OpenFiles, RunFiles, destinations_of
from catstream.pipeline import Pipeline
from catstream.processes.job import Results
from catstream.processes.state import contains_run, files_of_state

if TYPE_CHECKING:
    from rich.console import Console

    from catstream.web.feed import PipelineFeed
    from catstream.web.server import Server

_SAME = 0.95  # overlap of boxes that were meant to be one


def _files_only(_: click.Context, __: click.Parameter, destinations: tuple[str, ...]) -> tuple[str, ...]:
    """Check that no destination is an address or a folder."""
    for dest in destinations:
        if dest != STDOUT and not is_file(dest):
            where = redacted(dest)
            raise click.UsageError(f"--write takes files, not {where}: attach it to the run, catstream sink {where}")
        if kind_of(dest) not in SINKS:
            raise click.UsageError(
                f"--write {dest}: expected a name that ends with .ndjson, .csv, .sqlite or .mp4, or -"
            )
    return destinations


#: Adds the options for files to write, as the argument `outputs`: the files, and whether tracks go to standard output.
_with_outputs = combined(
    "outputs",
    lambda output, video, write, rotate, keep, saved: (
        Results(  # absolute, to resume from any folder; a resumed run keeps the files that are None
            output=output and output.absolute(),
            video=video,
            write=tuple(Path(dest).absolute() for dest in write if dest != STDOUT) if write else None,
            models={name: file.absolute() for name, file in saved.items()},
            rotate=rotate,
            keep=keep,
        ),
        STDOUT in write,
    ),
    click.option("--output", type=FOLDER, metavar="DIR", help="Folder for the results."),
    click.option("--video/--no-video", default=None, help="Also write the annotated video."),
    click.option(
        "--write", multiple=True, metavar="FILE", callback=_files_only, help="Write tracks to FILE; repeatable."
    ),
    click.option("--rotate", metavar="1d|500MB", help="Rotate the files of a live source."),
    click.option("--keep", type=click.IntRange(min=1), metavar="N", help="Rotated files to keep."),
    with_overwrite,
    with_files("--save-model", "saved", "Save the model of an object at the end."),
)


@click.command()
@click.argument("source", required=False)
@with_object
@_with_outputs
@with_view
@click.option("--paused", is_flag=True, help="Start paused, until `catstream resume`.")
@click.option("--state", type=PATH, metavar="DIR", help="Write checkpoints to this folder.")
@click.option("--resume", type=FOLDER, metavar="DIR", help="Resume the run of a --state folder.")
@click.option("--continue", "continues", is_flag=True, help="Resume the run in --state, or start it.")
@click.option("--lockstep", is_flag=True, help="Wait for each model: reproducible, slower.")
@with_part
@with_overrides
@with_reading
def track(
    source: str | None,
    boxes: dict[str, Box],
    models: dict[str, Path],
    outputs: tuple[Results, bool],
    overwrite: bool,
    view: HostPort | None,
    paused: bool,
    state: Path | None,
    resume: Path | None,
    continues: bool,
    lockstep: bool,
    part: slice,
    overrides: dict[str, object],
) -> None:
    """Track one or several objects in a video.

    SOURCE is a video, a folder or pattern of images (images/%05d.png), a camera
    (0), a stream (rtsp://..., http://...) or demo:1. Each object has a --box or
    a --model; without one, the run waits for `catstream set-box` or the page.

    DIR/NAME.ndjson and NAME.csv get the tracks, NAME.mp4 the --video. The suffix
    of --write selects .ndjson, .csv, .sqlite or .mp4; - is standard output. MQTT,
    webhooks and pictures of events: `catstream sink`; other formats: `export`.

    Ctrl-C keeps the results so far. A run with --state continues with --resume
    after a crash, with the same objects, source, settings and results.

    \b
    EXAMPLES
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
      catstream track walk.mp4 --box anna=120,80,64,48 --box ben=300,90,60,150 --view
      catstream track walk.mp4 --box 120,80,64,48 --write - | jq .box
      catstream track walk.mp4 --box 120,80,64,48 --start 500 --end 900 --save-model walker
      catstream track 0 --model walker --output out --state checkpoints --continue
      catstream track --resume checkpoints
    """
    if overwrite and (resume or continues):
        raise click.UsageError("--overwrite replaces existing results, --resume and --continue continue them: omit one")
    results, to_stdout = outputs
    if continues:
        if state is None:
            raise click.UsageError("missing --state DIR: --continue needs the folder of the run, which it may create")
        if contains_run(state):
            click.echo(f"the resumed run in {state} keeps its objects", err=True)
            resume, state, boxes, models = state, None, {}, {}
    if source is None and resume is None:
        raise click.UsageError("missing SOURCE: a video, a folder of images, a camera or a stream")
    pipeline = Pipeline(
        source,
        boxes or None,
        overrides | ({"run.lockstep": True} if lockstep else {}),
        model=models or None,
        part=part,
        state=state,
        resume=resume,
        paused=paused,
        results=results,
    )
    run = _Run(pipeline, resume is not None, to_stdout, overwrite, view)
    run.check()
    console = messages()
    _print(console, _doubtful(boxes, models, results.models, *pipeline.size))
    outcome = run.execute(console)
    _print(console, outcome.lines())
    if outcome.interrupted:
        stopped(outcome.interruption())


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of a run.

    folder      folder of its state; None without one
    is_resumed  whether the run of the folder has continued
    frames      number of tracked frames
    missing     results that another program removed, or that were never written
    models      files of the models to save; `saved`: of the saved ones
    """

    folder: Path | None
    is_resumed: bool
    frames: int = 0
    missing: Sequence[str] = ()
    models: Sequence[Path] = ()
    saved: Sequence[Path] = ()
    interrupted: bool = False

    def lines(self) -> Iterator[str]:
        """Yield the lines after the summary."""
        if self.missing:
            yield f"missing results, removed or never written: {', '.join(self.missing)}"
        if not self.frames and not self.is_resumed:
            yield "no frame was tracked"
        elif not self.frames and not self.interrupted:
            yield (
                f"no frames remained to track, the run in {self.folder} is complete: to track the source again, start "
                "a new run in another folder (--state DIR)"
            )
        yield from (f"saved model: {file}" for file in self.saved)

    def interruption(self) -> str:
        """Return what an interrupted run leaves, and how to continue it."""
        parts = ["some results are missing"] if self.missing else []
        if not self.missing and (self.frames or self.is_resumed):
            parts.append("the results so far are kept")
        if unsaved := [str(file) for file in self.models if file not in self.saved]:
            parts.append(f"not saved: {', '.join(unsaved)}")
        if self.folder is not None and contains_run(self.folder):
            parts.append(f"to continue: catstream track --resume {quote(str(self.folder))}")
        elif self.folder is not None:
            parts.append(f"the state in {self.folder} was removed, so the run cannot be resumed")
        return "; ".join(parts)


@dataclass(frozen=True, slots=True)
class _Run:
    """A run with its files.

    is_resumed  whether the run of a state folder continues
    stdout      whether tracks are also written to standard output
    overwrite   whether existing files are replaced
    view        address of the web page; None without one
    """

    pipeline: Pipeline
    is_resumed: bool
    stdout: bool
    overwrite: bool
    view: HostPort | None

    @property
    def files(self) -> RunFiles:
        """All files of tracks."""
        pipeline, results = self.pipeline, self.pipeline.results
        destinations = [*destinations_of(pipeline.name, results), *([STDOUT] if self.stdout else [])]
        options = SinkOptions(rotate=parse_rotation(results.rotate) if results.rotate else None, keep=results.keep or 0)
        origin = Origin(pipeline.header, Address(keys=pipeline.settings.run.keys), options)
        return RunFiles(origin, results.output, destinations)

    def check(self) -> None:
        """Raise VideoError or UsageError if a file of the run could not be written."""
        pipeline, results, files = self.pipeline, self.pipeline.results, self.files
        if results.video and results.output is None:
            raise click.UsageError("--video requires --output, the folder for the video")
        others = {f"the saved model of {name or 'the object'}": file for name, file in results.models.items()}
        if pipeline.state is not None:
            others |= files_of_state(pipeline.state)
        earlier = destinations_of(pipeline.name, pipeline.earlier_results)
        files.check(overwrite=self.overwrite, earlier=earlier, others=others)
        for file in set(results.models.values()) - set(pipeline.earlier_results.models.values()):
            check_result(file, overwrite=self.overwrite, source=pipeline.source, made=results.output)

    def execute(self, console: Console) -> Outcome:
        """Run to the end, and print a summary, also after an error."""
        pipeline, files, models = self.pipeline, self.files, [*self.pipeline.results.models.values()]
        if self.is_resumed:
            if all(file.exists() for file in models) and files.is_complete(pipeline.frames):
                return Outcome(pipeline.state, is_resumed=True)
            skip_damaged = pipeline.settings.run.skip_damaged
            pipeline.first_frame, pipeline.first_time = files.position(skip_damaged=skip_damaged)
        page = None if self.view is None else self._page(self.view)  # a port in use is an error before the run
        progress, interrupted = RunProgress(pipeline), False
        try:
            # The processes end before the files are closed: otherwise, they would track frames that no file gets. The
            # page is served until it shows the end.
            with ExitStack() as closed_last, pipeline:
                if page is not None:
                    self._serve(*page, closed_last, console)
                self._write_tracks(progress, closed_last, console)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            if progress.frames and not isinstance(sys.exception(), BrokenPipeError):
                console.print(progress.summary())
        missing = files.missing() if progress.frames else ()
        saved = pipeline.saved_models
        return Outcome(pipeline.state, self.is_resumed, progress.frames, missing, models, saved, interrupted)

    @staticmethod
    def _page(view: HostPort) -> tuple[PipelineFeed, Server]:
        """The web page of a pipeline whose address is not known yet, and its server, which listens already."""
        from catstream.web.app import Site
        from catstream.web.feed import PipelineFeed

        feed = PipelineFeed(Address())
        return feed, server_of(Site(feed), view)

    def _serve(self, feed: PipelineFeed, server: Server, stack: ExitStack, console: Console) -> None:
        """Serve the page until it shows the end of the run."""
        feed.address = Address(self.pipeline.endpoint, keys=self.pipeline.settings.run.keys)
        stack.enter_context(server.in_background())
        stack.callback(feed.wait_for_end)
        for url in server.urls:
            console.print(f"page: {url}")

    def _write_tracks(self, progress: RunProgress, stack: ExitStack, console: Console) -> None:
        """Write every track to all files, which the stack closes, and show it."""
        pipeline, has_said = self.pipeline, False
        outputs: OpenFiles | None = None
        if self.is_resumed:
            skip_damaged = pipeline.settings.run.skip_damaged
            outputs = self.files.opened(pipeline.endpoint, resume=True, skip_damaged=skip_damaged)
            stack.enter_context(outputs)
        moment = time.perf_counter()
        with console.status("starting", refresh_per_second=8) as status:
            for tracks in pipeline.by_frame(REFRESH_SECONDS):
                if not has_said and "detector" in pipeline.health:  # it answers commands from now on
                    has_said = True
                    self._print_hint(console)
                if not tracks:
                    progress.idle()
                    progress.show(status, console)
                    continue
                if outputs is None:
                    # New files are opened with the first track: a run that cannot start does not change older results.
                    # They are checked again: while this one waited, another run may have written them.
                    self.check()
                    outputs = stack.enter_context(self.files.opened(pipeline.endpoint))
                before, moment = moment, time.perf_counter()
                with INTERRUPTS.deferred():  # so that a frame is in all results or in none
                    outputs.write(TrackedFrame([*tracks.values()], moment - before))
                    pipeline.report_unwritten(outputs.not_written, outputs.trouble)
                    progress.count(tracks)
                    progress.not_written = outputs.not_written
                    progress.show(status, console)

    def _print_hint(self, console: Console) -> None:
        """Print how to continue a run that is paused or has no object."""
        endpoint = f"--endpoint {quote(self.pipeline.endpoint)}"
        if self.pipeline.holding == "waiting":
            page = "the page" if self.view is not None else f"the page of catstream view {endpoint}"
            ways = f"draw one on {page}, or run catstream set-box [NAME=]X,Y,W,H {endpoint}"
            console.print(f"waiting for a box: {ways}")
        elif self.pipeline.holding == "paused":
            console.print(f"paused: to continue, catstream resume {endpoint}")


def _print(console: Console, lines: Iterable[str]) -> None:
    for line in lines:
        console.print(line)


def _doubtful(
    boxes: Mapping[str, Box], models: Collection[str], saved: Collection[str], width: int, height: int
) -> list[str]:
    """Descriptions of objects that can be tracked, but are probably a mistake.

    The box is the whole frame, or two objects have the same box; or the box reaches out of the frame or covers more
    than a quarter of it, and its four numbers may be two corners. Or a model is to be `saved` under another name.

    >>> _doubtful({"anna": Box(8, 9, 40, 40), "ben": Box(8, 9, 40, 40)}, {}, {}, 320, 240)
    ['anna and ben have the same box: each costs time']
    >>> print(*_doubtful({"": Box(213, 121, 234, 216)}, {}, {}, 352, 288))
    a box of 234x216 in a frame of 352x288: if 213,121,234,216 are two corners, pass 213,121,21,95
    """
    whole = Box(0, 0, width, height)
    doubts = [
        f"the box of {listed([name])} is the whole frame: draw it around one object"
        for name, box in boxes.items()
        if box.overlap(whole) > _SAME
    ]
    doubts += [
        f"{name and name + ': '}a box of {w:g}x{h:g} in a frame of {width}x{height}: "
        f"if {x:g},{y:g},{w:g},{h:g} are two corners, pass {x:g},{y:g},{w - x:g},{h - y:g}"
        for name, (x, y, w, h) in boxes.items()
        if 0 <= x < w <= width
        and 0 <= y < h <= height
        and x + y > 0
        and (x + w > width or y + h > height or 4 * w * h > width * height)
    ]
    objects = {*boxes, *models}
    if objects and (unknown := {*saved} - objects - {UNNAMED}):  # without a name, the only one is meant
        names = listed(sorted(unknown))
        doubts.append(f"there is no object {names} yet: its model is saved if one begins under this name")
    return doubts + [
        f"{one} and {other} have the same box: each costs time"
        for (one, box), (other, twin) in combinations(boxes.items(), 2)
        if box.overlap(twin) > _SAME
    ]
