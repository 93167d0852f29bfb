"""`catstream track`: track objects in a video."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from catstream.box import Box
from catstream.cli.common import INTERRUPTS, RunProgress, messages, stopped
from catstream.cli.export import with_table
from catstream.cli.view import PORT, Address, AddressType, with_token
from catstream.errors import require_extra
from catstream.messages.names import UNNAMED, doubtful, listed
from catstream.pipeline import Pipeline
from catstream.run.job import Results
from catstream.services.options import (
    FOLDER,
    PATH,
    with_files,
    with_given,
    with_object,
    with_overwrite,
    with_part,
    with_reading,
)
from catstream.sinks.destinations import STDOUT, Origin, TrackedFrame, check_file, is_file
from catstream.sinks.run_files import RunFiles, places_of


@dataclass(frozen=True, slots=True, kw_only=True)
class _Request:
    """The options of the command.

    given   the settings that were given
    boxes   the objects in the first frame, by name
    models  the saved models of objects that are searched for, by name
    saved   the files for what is learned of each object, by name
    view    address of the web page; None for none
    """

    source: str | None
    boxes: dict[str, Box]
    models: dict[str, Path]
    given: dict[str, object]
    part: slice
    output: Path | None
    video: bool
    write: tuple[str, ...]
    overwrite: bool
    saved: dict[str, Path]
    view: Address | None
    token: str | None
    lockstep: bool
    paused: bool
    state: Path | None
    resume: Path | None

    @property
    def folder(self) -> Path | None:
        """The folder of the checkpoints, None if there are none."""
        return self.state or self.resume

    def check(self) -> None:
        """Raise UsageError if the options contradict each other."""
        if self.state and self.resume:
            raise click.UsageError("--state starts a new run, and --resume continues one: give one of them")
        if not self.resume and not self.source:
            raise click.UsageError("a run needs SOURCE: a video, a folder of images, a camera or a stream")
        if self.resume and self.overwrite:
            raise click.UsageError(
                "--resume continues the existing results, and --overwrite replaces them: give one of them"
            )
        if UNNAMED in self.saved and len(self.boxes) + len(self.models) > 1:
            raise click.UsageError("--save-model FILE is for a single object: for each of several, give NAME=FILE")

    def pipeline(self) -> Pipeline:
        """The pipeline of the run, not started; a resumed run continues the results of its earlier part."""
        return Pipeline(
            self.source,
            self.boxes or None,
            self.given | ({"run.lockstep": True} if self.lockstep else {}),
            model=self.models or None,
            part=self.part,
            state=self.state,
            resume=self.resume,
            paused=self.paused,
            results=Results(  # absolute, to resume from any folder
                output=self.output and self.output.absolute(),
                video=self.video,
                write=tuple(str(Path(it).absolute()) if is_file(it) else it for it in self.write if it != STDOUT),
                models={name: file.absolute() for name, file in self.saved.items()},
            ),
        )

    def files(self, pipeline: Pipeline) -> RunFiles:
        """Everything that the tracks are written to, including the standard output if requested."""
        results, settings = pipeline.results, pipeline.settings.run
        places = [*places_of(pipeline.name, results.output, results.video), *results.write]
        places += [STDOUT] if STDOUT in self.write else []
        origin = Origin(pipeline.source, pipeline.part, settings.image_rate, keys=settings.keys)
        return RunFiles(origin, results.output, [*dict.fromkeys(places)])


@click.command()
@click.argument("source", required=False)
@click.option("--output", type=PATH, help="Folder for the results.")
@click.option("--video", is_flag=True, help="Write OUTPUT/NAME.mp4 too, with boxes drawn in.")
@click.option("--write", multiple=True, metavar="DEST", help="Also write the tracks to DEST; may be repeated.")
@with_overwrite
@with_files("--save-model", "saved", "Save the model of an object to FILE at the end.")
@click.option(
    "--view",
    type=AddressType(),
    is_flag=False,
    flag_value=str(PORT),
    metavar="[[HOST:]PORT]",
    help="Serve a web page of the run.",
)
@with_token("view-")
@click.option("--lockstep", is_flag=True, help="Wait for each model: the run is reproducible bit for bit.")
@click.option("--paused", is_flag=True, help="Start paused, until `catstream resume`.")
@click.option("--state", type=PATH, help="Folder for checkpoints, to resume the run from.")
@click.option("--resume", type=FOLDER, help="Resume the run of such a folder.")
@with_object
@with_part
@with_given
@with_reading
@with_table(sinks=True)
def track(**options: Any) -> None:
    """Track one or several objects in a video.

    An object is given by its box in the first frame, or by a saved model. If
    none is given, tracking starts after `catstream set-box`, or after a box is
    drawn on the web page.

    Several objects have names: --box NAME=X,Y,W,H or --model NAME=FILE for each
    of them. More can be added, and others forgotten, during the run:
    `catstream set-box NAME=X,Y,W,H` and `catstream forget NAME`.

    SOURCE is a video file, a folder of images, a pattern like
    images/%05d.png, a camera (0 or /dev/video0), or a stream (rtsp://... or
    http://... for MJPEG). Cameras and streams are live: only the newest frame
    is tracked, the frames before it are skipped and counted, and a lost source
    is opened again until it is available. demo:1 is a live source without a
    camera: see `catstream demo`.

    The detector, the compressor and the trainer run as separate processes.
    Ctrl-C, SIGTERM and the loss of the terminal end them; the results so far
    are kept.

    With --state, a checkpoint is written once a second. After a power failure,
    a crash or Ctrl-C, --resume continues the run with the objects that it had,
    and with the same source, settings and results unless they are given again.

    \b
    Writes
      OUTPUT/NAME.ndjson   one JSON object for each track, with all its fields
      OUTPUT/NAME.csv      a row for each object and frame: frame, seconds, state, box,
                           score, model version, object, processing time
      OUTPUT/NAME.mp4      with --video

    NAME is the name of the source, so that several sources can share a folder;
    a/walk.mp4 and b/walk.mp4 need a folder each. `catstream export` makes MOT
    text, the files of benchmarks, SQLite and Parquet from these.

    --write DEST, may be repeated; the suffix selects the format

    {table}

    Existing files are not replaced without --overwrite.

    \b
    EXAMPLES
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
      catstream track frames/ --box 120,80,64,48 --output out --set coreset.size=128
      catstream track walk.mp4 --box 120,80,64,48 --write - | jq .box
      catstream track walk.mp4 --box anna=120,80,64,48 --box ben=300,90,60,150 --video --output out
      catstream track walk.mp4 --box 120,80,64,48 --save-model walker.safetensors
      catstream track walk.mp4 --box 120,80,64,48 --output out --lockstep
      catstream track walk.mp4 --box 90,75,60,45 --start 500 --end 900 --stride 2
      catstream track walk.mp4 --box 120,80,64,48 --write walk.mcap
      catstream track walk.mp4 --box 120,80,64,48 --paused --set run.endpoint=run
      catstream track rtsp://10.0.0.7/stream1 --box 120,80,64,48 --output out
      catstream track 0 --model walker.safetensors
      catstream track 0 --view
      catstream track 0 --view 0.0.0.0:8000
      catstream track walk.mp4 --box 120,80,64,48 --output out --state checkpoints
      catstream track --resume checkpoints
    """
    request = _Request(**options)
    request.check()
    pipeline = request.pipeline()
    if request.view is not None:
        require_extra("view")
    files = request.files(pipeline)
    _check_files(request, pipeline, files)
    console = messages()
    for line in _doubts(request, pipeline):
        console.print(line)
    if request.resume is not None:
        pipeline = pipeline.starting_after(files.position())
    _Run(request, pipeline, files, console).execute()


def _check_files(request: _Request, pipeline: Pipeline, files: RunFiles) -> None:
    """Raise an error before the run if one of its files could not be written."""
    if pipeline.results.video and files.output is None:
        raise click.UsageError("--video requires --output, the folder for the video")
    earlier = pipeline.earlier_results
    continued = [*places_of(pipeline.name, earlier.output, earlier.video), *earlier.write]
    files.check(overwrite=request.overwrite, earlier=continued)
    for file in request.saved.values():
        check_file(file, may_exist=request.overwrite, source=pipeline.source, made=files.output)


def _doubts(request: _Request, pipeline: Pipeline) -> Iterator[str]:
    """Yield descriptions of options that are valid, but hardly are what was meant."""
    objects = {*request.boxes, *request.models}
    if objects and (unknown := request.saved.keys() - objects - {UNNAMED}):  # without a name, the only one is meant
        yield f"there is no object {listed(sorted(unknown))} yet: its model is saved if one begins under this name"
    yield from doubtful(request.boxes, *pipeline.size)


class _Run:
    """Runs the pipeline, writes its tracks to the files, and prints the progress and the results."""

    def __init__(self, request: _Request, pipeline: Pipeline, files: RunFiles, console: Console) -> None:
        self._request, self._pipeline, self._files, self._console = request, pipeline, files, console
        self._progress = RunProgress(pipeline)

    def execute(self) -> None:
        """Run to the end, or until Ctrl-C or a signal; then the exit code is `INTERRUPTED`."""
        try:
            interrupted = self._run()
        finally:
            if self._progress.frames and not isinstance(sys.exception(), BrokenPipeError):
                self._print_summary()
        request, folder = self._request, self._request.folder
        if request.resume is not None and not self._progress.frames and not interrupted:
            self._console.print(
                f"no frames were left to track, the run in {request.resume} is complete: to track the source again, "
                "start a new run in another folder (--state DIR)"
            )
        saved = self._pipeline.saved_models
        for file in saved:
            self._console.print(f"saved model: {file}")
        if interrupted:
            unsaved = [str(file) for file in self._pipeline.results.models.values() if file not in saved]
            lost = f"; not saved: {', '.join(unsaved)}" if unsaved else ""
            hint = f"; to continue: catstream track --resume {folder}" if folder is not None else ""
            stopped(f"the results so far are kept{lost}{hint}")

    def _run(self) -> bool:
        """Run the pipeline, with the web page if there is one; return whether Ctrl-C or a signal ended it."""
        try:
            # The files are closed after the processes, which would track on meanwhile, for none of them.
            with ExitStack() as files, self._pipeline, ExitStack() as stack:
                self._files.make_folder()
                if self._request.view is not None:
                    self._serve(self._request.view, stack)
                if self._pipeline.holding == "waiting":
                    self._console.print(f"waiting for a box: {self._ways_to_set_box()}")
                elif self._pipeline.holding:
                    self._console.print(f"paused: to continue, catstream resume --endpoint {self._pipeline.endpoint}")
                self._write_tracks(files)
        except KeyboardInterrupt:
            return True
        return False

    def _serve(self, view: Address, stack: ExitStack) -> None:
        """Serve the web page of the pipeline until the stack is left."""
        from catstream.web.app import pipeline_site
        from catstream.web.server import Server

        site = pipeline_site(self._pipeline.endpoint, self._pipeline.settings.run.keys)
        server = Server(site, host=view.host, port=view.port, token=self._request.token)
        stack.enter_context(server.in_background())
        for url in server.urls:
            self._console.print(f"page: {url}")

    def _ways_to_set_box(self) -> str:
        place = f"--endpoint {self._pipeline.endpoint}"
        page = "the page" if self._request.view is not None else f"the page of catstream view {place}"
        return f"draw one on {page}, or run catstream set-box [NAME=]X,Y,W,H {place}"

    def _write_tracks(self, stack: ExitStack) -> None:
        """Write every track to all files, which the stack closes, and show the progress."""
        with self._progress.progress(self._console) as progress:
            resume, endpoint = self._request.resume is not None, self._pipeline.endpoint
            write = stack.enter_context(self._files.opened(endpoint, resume=True)) if resume else None
            moment = time.perf_counter()
            for tracks in self._pipeline.by_frame():
                # New files are opened with the first track: a run that cannot start does not change older results.
                write = write or stack.enter_context(self._files.opened(endpoint))
                before, moment = moment, time.perf_counter()
                with INTERRUPTS.deferred():  # so that a frame is in all results or in none
                    write(TrackedFrame([*tracks.values()], moment - before))
                    self._progress.show(progress, tracks)

    def _print_summary(self) -> None:
        output = [] if self._files.output is None else [self._files.output]
        self._console.print(self._progress.summary([*output, *map(Path, self._pipeline.results.write)]))
