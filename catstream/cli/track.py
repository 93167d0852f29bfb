"""`catstream track`: track objects in a video."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import click
from rich.console import Console

from catstream.box import Box
from catstream.cli import INTERRUPTED
from catstream.cli.interrupts import Interrupts
from catstream.cli.progress import RunProgress
from catstream.cli.serving import PORT, Address, AddressType, with_token
from catstream.errors import RecordingError, ServiceError, require_extra
from catstream.messages.kinds import Track
from catstream.messages.names import UNNAMED, doubtful, listed
from catstream.messages.storage import why_not_writable
from catstream.pipeline import Pipeline
from catstream.run.job import Results
from catstream.services.options import named, with_given, with_object, with_part, with_reading
from catstream.sinks.recording.file import Recording
from catstream.sinks.run import RunFiles
from catstream.sinks.sink import STDOUT

__all__ = ["track"]

_FOLDER = _FILE = click.Path(path_type=Path)


@click.command()
@click.argument("source", required=False)
@click.option("--output", type=_FOLDER, help="Folder for the results.")
@click.option("--video", is_flag=True, help="Write OUTPUT/NAME.mp4 too, with boxes drawn in.")
@click.option("--write", type=_FILE, multiple=True, metavar="FILE", help="Also write the tracks to FILE; - for stdout.")
@click.option("--overwrite", is_flag=True, help="Replace existing results.")
@click.option(
    "--save-model", multiple=True, metavar="[NAME=]FILE", help="Save the model of an object to FILE at the end."
)
@click.option("--record", type=click.Path(path_type=Path), help="Record the run to a file for `catstream replay`.")
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
@click.option("--state", type=_FOLDER, help="Folder for checkpoints, to resume the run from.")
@click.option("--resume", type=_FOLDER, help="Resume the run of such a folder.")
@with_object
@with_part
@with_given
@with_reading
def track(
    given: dict[str, object],
    part: slice,
    source: str | None,
    boxes: dict[str, Box],
    models: dict[str, Path],
    output: Path | None,
    video: bool,
    write: tuple[Path, ...],
    overwrite: bool,
    save_model: tuple[str, ...],
    record: Path | None,
    view: Address | None,
    token: str | None,
    lockstep: bool,
    state: Path | None,
    resume: Path | None,
) -> None:
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
    a crash or Ctrl-C, --resume continues the run, with the same source, box,
    settings and results unless they are given again.

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
    if state is not None and resume is not None:
        raise click.UsageError("--state starts a new run, and --resume continues one: give one of them")
    if resume is None and source is None:
        raise click.UsageError("a run needs SOURCE: a video, a folder of images, a camera or a stream")
    if resume is not None and overwrite:
        raise click.UsageError(
            "--resume continues the existing results, and --overwrite replaces them: give one of them"
        )
    saved = {name: Path(file) for name, file in named("--save-model", save_model).items()}
    pipeline = Pipeline(
        source,
        boxes or None,
        given | ({"run.lockstep": True} if lockstep else {}),
        model=models or None,
        part=part,
        state=state,
        record=record,
        resume=resume,
        results=Results(  # absolute, to resume from any folder
            output=output and output.absolute(),
            video=video,
            write=tuple(file.absolute() for file in write if file != STDOUT),
            models={name: file.absolute() for name, file in saved.items()},
        ),
    )
    results, earlier = pipeline.results, pipeline.earlier_results
    if view is not None:
        require_extra("view")
    files = _files(pipeline, results, STDOUT in write, [*boxes, *models])
    files.check_writable(
        overwrite=overwrite,
        resumable=state is not None or resume is not None,
        known=[*earlier.write, *([earlier.output] if earlier.output is not None else [])],
    )
    _check_models(saved, overwrite)
    if UNNAMED in saved and len(boxes) + len(models) > 1:
        raise click.UsageError("--save-model FILE is for a single object: for each of several, give NAME=FILE")
    console = Console(stderr=True, soft_wrap=True)
    if (boxes or models) and (unknown := saved.keys() - {*boxes, *models}):
        console.print(
            f"there is no object {listed(sorted(unknown))} yet: its model is saved if one begins under this name",
            highlight=False,
        )
    for line in doubtful(boxes, *pipeline.size):
        console.print(line, highlight=False)
    if resume is not None:
        pipeline = pipeline.starting_after(files.position())
    output = results.output
    if resume is not None and pipeline.complete:
        if boxes:
            raise click.UsageError(f"{_complete(pipeline, resume, output)}: no frame is left for a box")
        if not files.complete:
            with files.opened(resume=True):  # creates new files, and those that are made at the end
                pass
        console.print(_complete(pipeline, resume, output), highlight=False)
        return
    recording: Recording | None = None
    run = RunProgress(pipeline, files.names() if resume is not None else ())
    serve = partial(_serve, pipeline, view, token, console) if view is not None else None
    try:
        interrupted = _run(pipeline, files, run, console, serve, resumed=resume is not None)
    finally:
        if run.frames and not isinstance(sys.exception(), BrokenPipeError):
            console.print(run.summary([*([output] if output is not None else []), *files.files]), highlight=False)
            if record is not None:
                recording = Recording(record)
                console.print(f"recording: {record}, {recording}", highlight=False)
    if resume is not None and not run.frames and not interrupted:
        console.print(f"no frames were left to track: the run in {resume} is complete", highlight=False)
    for file in results.models.values():
        console.print(f"saved model: {file}", highlight=False)
    if interrupted:
        hint = f"; to continue: catstream track --resume {state or resume}" if state or resume else ""
        console.print(f"stopped: the results so far are kept{hint}", highlight=False)
        sys.exit(INTERRUPTED)
    if recording is not None and not recording.complete:
        raise RecordingError(f"{record} is not complete: see why above, and record the run again if you need it whole")


def _run(
    pipeline: Pipeline,
    files: RunFiles,
    run: RunProgress,
    console: Console,
    serve: Callable[[ExitStack], None] | None,
    *,
    resumed: bool,
) -> bool:
    """Run the pipeline to its end, with the page if `serve` starts one; returns whether Ctrl-C or a signal ended it."""
    interrupts = Interrupts()
    interrupts.install()
    try:
        with pipeline, ExitStack() as stack:
            if serve is not None:
                serve(stack)
            if pipeline.waits:
                console.print(f"waiting for a box: {_ways_to_set_box(pipeline, serve is not None)}", highlight=False)
            _write_tracks(pipeline, files, run, console, interrupts, resumed=resumed)
    except KeyboardInterrupt:
        return True
    return False


def _serve(pipeline: Pipeline, view: Address, token: str | None, console: Console, stack: ExitStack) -> None:
    """Serve the web page of a pipeline until the stack is left."""
    from catstream.web.app import pipeline_site
    from catstream.web.server import Server

    site = pipeline_site(pipeline.endpoint, pipeline.settings.run.keys)
    server = Server(site, host=view.host, port=view.port, token=token)
    stack.enter_context(server.in_background())
    for url in server.urls:
        console.print(f"page: {url}", highlight=False, soft_wrap=True)


def _write_tracks(
    pipeline: Pipeline, files: RunFiles, run: RunProgress, console: Console, interrupts: Interrupts, *, resumed: bool
) -> None:
    """Write every track to all files, and show the progress."""
    with run.progress(console) as progress, ExitStack() as stack:
        write: Callable[[Mapping[str, Track], float], None] | None = None
        moment = time.perf_counter()
        for tracks in pipeline.by_frame():
            # The files are opened with the first track: a run that cannot start does not change older results.
            write = write or stack.enter_context(files.opened(resume=resumed))
            before, moment = moment, time.perf_counter()
            with interrupts.deferred():  # so that a frame is in all results or in none
                write(tracks, moment - before)
                run.show(progress, tracks)


def _complete(pipeline: Pipeline, resume: Path, output: Path | None) -> str:
    """The message for a resumed run that is complete."""
    results = f", its results are in {output}" if output is not None else ""
    return (
        f"the run in {resume} is complete, all {pipeline.frames} frames were tracked{results}; "
        "to track the source again, start a new run in another folder (--state DIR)"
    )


def _files(pipeline: Pipeline, results: Results, stdout: bool, objects: Sequence[str]) -> RunFiles:
    """The files to which the tracks are written, including the standard output if requested."""
    files = RunFiles(
        pipeline.name,
        pipeline.source,
        pipeline.part,
        results.output,
        results.video,
        [*results.write, *([STDOUT] if stdout else [])],
        pipeline.settings.run.image_rate,
        objects,
    )
    if files.video and files.output is None:
        raise click.UsageError("--video requires --output, the folder for the video")
    if pipeline.live and (files.video or any(file.suffix == ".mp4" for file in files.files)):
        raise click.UsageError(
            "a video needs the frames once more, and a live source cannot repeat them: omit the video"
        )
    return files


def _check_models(files: Mapping[str, Path], overwrite: bool) -> None:
    """Raise ServiceError if one of the files for models cannot be written."""
    for name, file in files.items():
        if file.exists() and not overwrite:
            raise ServiceError(f"{file} exists already: replace it with --overwrite, or give another name")
        if reason := why_not_writable(file):
            raise ServiceError(reason)
        if any(file == other for named, other in files.items() if named != name):
            raise ServiceError(f"{file} is named twice: give each object its own file")


def _ways_to_set_box(pipeline: Pipeline, page: bool) -> str:
    place = f"--endpoint {pipeline.endpoint}"
    drawn = "draw one on the page" if page else f"draw one on the page of catstream view {place}"
    return f"{drawn}, or run catstream set-box [NAME=]X,Y,W,H {place}"
