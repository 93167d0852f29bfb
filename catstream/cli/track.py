"""`catstream track`: follow an object through a video."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from catstream.box import Box
from catstream.cli import INTERRUPTED
from catstream.cli.interrupts import Interrupts
from catstream.cli.serving import PORT, Address, AddressType, with_token
from catstream.extras import need
from catstream.messages import Track
from catstream.pipeline import Pipeline
from catstream.recording.file import Recording
from catstream.services.options import with_given, with_object, with_part, with_reading
from catstream.video.results import ResultsWriter, last_position, tracks

__all__ = ["track"]

_FOLDER = click.Path(path_type=Path)


@click.command()
@click.argument("source", required=False)
@click.option("--output", type=_FOLDER, help="Folder for the results.")
@click.option("--video", is_flag=True, help="Write OUTPUT/NAME.mp4 too, with boxes drawn in.")
@click.option("--record", type=click.Path(path_type=Path), help="File to record the run to: `catstream replay`.")
@click.option(
    "--view",
    type=AddressType(),
    is_flag=False,
    flag_value=str(PORT),
    metavar="[[HOST:]PORT]",
    help="Serve a web page of it.",
)
@with_token("view-")
@click.option("--lockstep", is_flag=True, help="Repeat a run bit for bit: wait for each model.")
@click.option("--state", type=_FOLDER, help="Folder to keep what was learned in, through power cuts.")
@click.option("--resume", type=_FOLDER, help="Go on with what is kept in such a folder.")
@with_object
@with_part
@with_given
@with_reading
def track(
    given: dict[str, Any],
    part: slice,
    source: str | None,
    box: Box | None,
    model: Path | None,
    output: Path | None,
    video: bool,
    record: Path | None,
    view: Address | None,
    token: str | None,
    lockstep: bool,
    state: Path | None,
    resume: Path | None,
) -> None:
    """Follow an object through a video.

    It is shown by its box in the first frame, or found by what was learned of
    it before, or waited for until `catstream set-box` says where it is, or
    somebody who draws a box on the web page.

    SOURCE is a video file, a folder of images, a pattern like
    images/%05d.png, a camera (0 or /dev/video0), or a stream (rtsp://... or
    http://... for MJPEG). Cameras and streams are live: each time the newest
    frame is followed, the others are skipped and counted, and one that is lost
    is opened again until it is back.

    A detector, a compressor and a trainer run as processes of their own;
    Ctrl-C ends them, as SIGTERM and a terminal that is lost do, and the results
    so far are kept.

    With --state, what was learned is kept too, on disk, once a second: after a
    power cut, a crash or Ctrl-C, --resume goes on where the run was, with the
    same source, box, settings and results, unless they are given again.

    \b
    Writes
      OUTPUT/NAME.txt               x,y,w,h a frame, nan where the object is absent
      OUTPUT/NAME_confidence.value  the score a frame
      OUTPUT/NAME_time.txt          seconds a frame
      OUTPUT/tracks.csv             frame, seconds, state, box, score, model version
      OUTPUT/NAME.mp4               with --video

    \b
    EXAMPLES
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
      catstream track frames/ --box 120,80,64,48 --output out --set coreset_size=128
      catstream track walk.mp4 --box 120,80,64,48 --output out --lockstep
      catstream track walk.mp4 --box 90,75,60,45 --start 500 --end 900 --stride 2
      catstream track walk.mp4 --box 120,80,64,48 --record walk.rec
      catstream track rtsp://10.0.0.7/stream1 --box 120,80,64,48 --output out
      catstream track 0 --model walker.safetensors
      catstream track 0 --view
      VIEW_TOKEN=$(openssl rand -hex 16) catstream track 0 --view 0.0.0.0:8000
      catstream track walk.mp4 --box 120,80,64,48 --output out --state kept
      catstream track --resume kept
    """
    if state is not None and resume is not None:
        raise click.UsageError("--state begins a run, --resume goes on with one: give one of them")
    if resume is None and source is None:
        raise click.UsageError("a run needs SOURCE: a video, a folder of images, a camera or a stream")
    pipeline = Pipeline(
        source,
        box,
        given | ({"lockstep": True} if lockstep else {}),
        model=model,
        part=part,
        state=state,
        record=record,
        resume=resume,
        notes=({"output": str(output.absolute())} if output is not None else {}) | ({"video": "yes"} if video else {}),
    )
    video, output = "video" in pipeline.notes, Path(pipeline.notes["output"]) if "output" in pipeline.notes else None
    if view is not None:
        need("view")
    if video and output is None:
        raise click.UsageError("--video needs --output, the folder to write it to")
    if video and pipeline.live:
        raise click.UsageError("--video reads the frames once more, and those of a live source are gone: leave it away")
    if resume is not None and output is not None:
        pipeline.after = last_position(output, pipeline.name)
    console = Console(stderr=True, soft_wrap=True)
    if resume is not None and pipeline.complete:
        if box is not None:
            raise click.UsageError(f"{_complete(pipeline, resume, output)}: no frame is left for a box")
        console.print(_complete(pipeline, resume, output), highlight=False)
        return
    interrupts = Interrupts()
    interrupts.install()
    run = _Run(pipeline)
    interrupted = False
    try:
        with ExitStack() as stack:
            stack.enter_context(pipeline)
            if view is not None:
                from catstream.web.server import Server

                server = Server(pipeline.endpoint, pipeline.settings.keys, host=view.host, port=view.port, token=token)
                stack.enter_context(server.beside())
                for url in server.urls:
                    console.print(f"page: {url}", highlight=False)
            if pipeline.waits:
                where = f" --endpoint {pipeline.endpoint}"
                console.print(f"it waits for a box: catstream set-box X,Y,W,H{where}", highlight=False)
            progress = stack.enter_context(run.progress(console))
            sinks = None
            for found in pipeline:
                # Not before there is something to write: a run that cannot start leaves older results alone.
                sinks = sinks or _Sinks(stack, pipeline, output, video, resume is not None)
                with interrupts.held():  # a frame is in all results, and counted, or in none
                    sinks.write(found)
                    run.show(progress, found)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        if run.frames:
            console.print(run.summary(output), highlight=False)
            if record is not None:
                console.print(f"recording: {record}, {Recording(record)}", highlight=False)
    if resume is not None and not run.frames and not interrupted:
        console.print(f"no frame was left to follow: the run in {resume} is complete", highlight=False)
    if interrupted:
        go_on = f", go on with: catstream track --resume {state or resume}" if state or resume else ""
        console.print(f"stopped: the results so far are kept{go_on}", highlight=False)
        sys.exit(INTERRUPTED)


def _complete(pipeline: Pipeline, resume: Path, output: Path | None) -> str:
    """Says that a run that is resumed has come to its end."""
    results = f", its results are in {output}" if output is not None else ""
    return (
        f"the run in {resume} is complete, all {pipeline.frames} frames were followed{results}; "
        "to follow the source again, begin a new run in another folder (--state DIR)"
    )


class _Sinks:
    """Where tracks go: results files, and a video of the same frames read once more."""

    def __init__(self, stack: ExitStack, pipeline: Pipeline, output: Path | None, video: bool, resume: bool) -> None:
        self._results: ResultsWriter | None = None
        if output is not None:
            self._results = stack.enter_context(ResultsWriter(output, pipeline.name, resume=resume))
        self._video: Any = None
        self._moment = time.perf_counter()
        if video and output is not None:
            from catstream.video.annotate import AnnotatedVideo
            from catstream.video.source import open_source

            # A run ends at a damaged place unless it skips those: either way these are its frames.
            self._frames = stack.enter_context(open_source(pipeline.source, part=pipeline.part, skip_damaged=True))
            path = output / f"{pipeline.name}.mp4"
            self._video = stack.enter_context(
                AnnotatedVideo(path, pipeline.rate, pipeline.size, sound=self._frames.sound)
            )
            for found in tracks(output) if resume else ():  # a video cannot be written on: it is drawn again
                self._video.write(next(self._frames).image, found, found.time)

    def write(self, found: Track) -> None:
        moment = time.perf_counter()
        if self._results is not None:
            self._results.write(found, moment - self._moment)
        self._moment = moment
        if self._video is not None:
            self._video.write(next(self._frames).image, found, found.time)


class _StateColumn(ProgressColumn):
    """The state of the track, or why no track comes to say so: the source is lost, or it is told to wait."""

    def __init__(self, pipeline: Pipeline) -> None:
        super().__init__()
        self._pipeline = pipeline

    def render(self, task: Task) -> Text:
        lost = self._pipeline.lost_seconds
        state = f"lost {lost:.0f} s" if lost else self._pipeline.holding or task.fields["state"]
        return Text(f"{state:13}")


class _Run:
    """What a person wants to see of a run, while it goes on and afterwards."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._started = time.perf_counter()
        self._first = 0.0
        self._shown = 0.0
        self.frames = self.present = 0
        self.version = 0

    def progress(self, console: Console) -> Progress:
        columns = (
            _StateColumn(self._pipeline),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[line]}"),
        )
        progress = Progress(*columns, console=console, transient=True, refresh_per_second=8)
        self._task = progress.add_task("", total=self._pipeline.frames, state="starting", line="")
        return progress

    def show(self, progress: Progress, found: Track) -> None:
        now = time.perf_counter()
        if not self.frames:
            self._first = now - self._started
        self.frames += 1
        self.present += found.box is not None
        self.version = found.model_version
        if now - self._shown < 0.1:
            return
        self._shown = now
        leaves = self._pipeline.health.get("compressor", {}).get("leaves", 0)
        skipped = f"{self._detector('skipped'):.0f} skipped   " if self._pipeline.live else ""
        line = (
            f"{self._rate(now):.0f} frames/s   {skipped}score {found.score:+.2f}   "
            f"model {found.model_version}   {leaves:.0f} leaves in the trees"
        )
        progress.update(self._task, completed=self.frames, state=found.state, line=line)

    def summary(self, output: Path | None) -> str:
        lines = [
            f"{self.frames} frames, present in {self.present}, {self._rate(time.perf_counter()):.0f} frames/s, "
            f"first track after {self._first:.2f} s, model version {self.version}"
        ]
        if self._pipeline.live:
            lines.append(
                f"live: {self._detector('skipped'):.0f} frames skipped, "
                f"lost and opened again {self._detector('reopened'):.0f} times"
            )
        if damaged := self._detector("damaged"):
            lines.append(f"damaged: {damaged:.0f} frames could not be decoded, and were left out")
        if totals := self._pipeline.totals:
            lines.append(f"features: {totals['sent']} messages sent, {totals['stored']} stored in the coreset trees")
        if self._pipeline.restarts:
            lines.append(f"processes restarted: {self._pipeline.restarts}")
        if output is not None:
            lines.append(f"results: {output}")
        return "\n".join(lines)

    def _detector(self, counter: str) -> float:
        return self._pipeline.health.get("detector", {}).get(counter, 0)

    def _rate(self, now: float) -> float:
        return (self.frames - 1) / max(now - self._started - self._first, 1e-9)
