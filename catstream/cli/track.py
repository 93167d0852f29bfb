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
from catstream.cli.common import INTERRUPTS, RunProgress, check_file, messages, stopped
from catstream.cli.view import PORT, Address, AddressType, with_token
from catstream.errors import RecordingError, ServiceError, require_extra
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
from catstream.sinks.recording.file import Recording
from catstream.sinks.run import RunFiles
from catstream.sinks.sink import STDOUT


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
    write: tuple[Path, ...]
    overwrite: bool
    saved: dict[str, Path]
    record: Path | None
    view: Address | None
    token: str | None
    lockstep: bool
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
            record=self.record,
            resume=self.resume,
            results=Results(  # absolute, to resume from any folder
                output=self.output and self.output.absolute(),
                video=self.video,
                write=tuple(file.absolute() for file in self.write if file != STDOUT),
                models={name: file.absolute() for name, file in self.saved.items()},
            ),
        )

    def files(self, pipeline: Pipeline) -> RunFiles:
        """The files to which the tracks are written, including the standard output if requested."""
        results = pipeline.results
        return RunFiles(
            pipeline.name,
            pipeline.source,
            pipeline.part,
            results.output,
            results.video,
            [*results.write, *([STDOUT] if STDOUT in self.write else [])],
            pipeline.settings.run.image_rate,
            [*self.boxes, *self.models],
        )


@click.command()
@click.argument("source", required=False)
@click.option("--output", type=PATH, help="Folder for the results.")
@click.option("--video", is_flag=True, help="Write OUTPUT/NAME.mp4 too, with boxes drawn in.")
@click.option("--write", type=PATH, multiple=True, metavar="FILE", help="Also write the tracks to FILE; - for stdout.")
@with_overwrite
@with_files("--save-model", "saved", "Save the model of an object to FILE at the end.")
@click.option("--record", type=PATH, help="Record the run to a file for `catstream replay`.")
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
@click.option("--state", type=PATH, help="Folder for checkpoints, to resume the run from.")
@click.option("--resume", type=FOLDER, help="Resume the run of such a folder.")
@with_object
@with_part
@with_given
@with_reading
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
      OUTPUT/NAME.txt               x,y,w,h of each frame, nan if the object is absent
      OUTPUT/NAME_confidence.value  score of each frame
      OUTPUT/NAME_time.txt          seconds for each frame
      OUTPUT/NAME.csv               frame, seconds, state, box, score, model version, object
      OUTPUT/NAME.mp4               with --video

    NAME is the name of the source, so that several sources can share a folder;
    a/walk.mp4 and b/walk.mp4 need a folder each. NAME.csv has a row for each
    object and frame. The first three files are of one object: NAME-anna.txt is
    that of anna.

    \b
    --write FILE, may be repeated; each file contains every object and frame
      .ndjson .jsonl   one JSON object per line, with the fields of a track
      -                the same, on standard output
      .csv             as OUTPUT/NAME.csv
      .txt             MOT text: frame,id,x,y,w,h,score,-1,-1,-1, counted from 1
      .mp4             the frames with their tracks drawn in
      .json            one array of the JSON objects
      .sqlite          the table tracks
      .parquet         the same table; needs pip install "catstream[parquet]"

    The last three are made at the end, from an .ndjson file of the same name,
    which is kept: --resume continues from it.

    Existing files are not replaced without --overwrite.

    \b
    EXAMPLES
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
      catstream track frames/ --box 120,80,64,48 --output out --set coreset.size=128
      catstream track walk.mp4 --box 120,80,64,48 --write tracks.parquet
      catstream track walk.mp4 --box 120,80,64,48 --write - | jq .box
      catstream track walk.mp4 --box anna=120,80,64,48 --box ben=300,90,60,150 --video --output out
      catstream track walk.mp4 --box 120,80,64,48 --save-model walker.safetensors
      catstream track walk.mp4 --box 120,80,64,48 --output out --lockstep
      catstream track walk.mp4 --box 90,75,60,45 --start 500 --end 900 --stride 2
      catstream track walk.mp4 --box 120,80,64,48 --record walk.mcap
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
    if files.video and files.output is None:
        raise click.UsageError("--video requires --output, the folder for the video")
    if pipeline.live and (files.video or any(file.suffix == ".mp4" for file in files.files)):
        raise click.UsageError(
            "a video needs the frames once more, and a live source cannot repeat them: omit the video"
        )
    earlier = pipeline.earlier_results
    files.check_writable(
        overwrite=request.overwrite,
        resumable=request.folder is not None,
        known=[*earlier.write, *([earlier.output] if earlier.output is not None else [])],
    )
    files.check_source_kept(request.saved.values())
    for file in request.saved.values():
        check_file(file, overwrite=request.overwrite, made=files.output)
        if [*request.saved.values(), *request.write, request.record].count(file) > 1:
            raise ServiceError(f"{file} is named twice: give each file once")


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
        self._progress = RunProgress(pipeline, files.names() if request.resume is not None else ())
        self._recording: Recording | None = None

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
        if self._recording is not None and not self._recording.complete:
            raise RecordingError(
                f"{request.record} is not complete: see why above, and record the run again if you need it whole"
            )

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
                    place = f"--endpoint {self._pipeline.endpoint}"
                    self._console.print(f"paused, as it was before: to continue, catstream resume {place}")
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
            resume = self._request.resume is not None
            # A frame that arrives while the files are written again would be in none of them after Ctrl-C.
            write = stack.enter_context(self._files.opened(resume=True)) if resume else None
            moment = time.perf_counter()
            for tracks in self._pipeline.by_frame():
                # New files are opened with the first track: a run that cannot start does not change older results.
                write = write or stack.enter_context(self._files.opened())
                before, moment = moment, time.perf_counter()
                with INTERRUPTS.deferred():  # so that a frame is in all results or in none
                    write(tracks, moment - before)
                    self._progress.show(progress, tracks)

    def _print_summary(self) -> None:
        folder = [self._files.output] if self._files.output is not None else []
        self._console.print(self._progress.summary([*folder, *self._files.files]))
        if self._request.record is not None:
            self._recording = Recording(self._request.record)
            self._console.print(f"recording: {self._request.record}, {self._recording}")
