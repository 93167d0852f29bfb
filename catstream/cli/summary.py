"""`catstream summary`: choose the images that represent a collection, or the frames that taught the tracker most."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console

from catstream.cli.common import INTERRUPTS, check_file, line_of, messages
from catstream.errors import ObjectError, SettingsError, VideoError
from catstream.messages.kinds import Features, Health
from catstream.messages.names import boxes_by_name, listed, split_name
from catstream.numerics.threads import one_thread
from catstream.run.job import Job
from catstream.services.options import PATH, with_given, with_overwrite
from catstream.settings import Settings
from catstream.sinks.recording.container import MAGIC
from catstream.sinks.recording.file import Recording
from catstream.sinks.recording.learning import require_features

if TYPE_CHECKING:
    from catstream.applications.summaries.sheet import Sheet

_RECORDING = ".mcap"
_SETTINGS = "--settings, --preset or --set"


@click.command()
@click.argument("path", type=PATH)
@click.option("-k", "count", type=click.IntRange(1), default=12, show_default=True, help="Number of images or frames.")
@click.option("--box", metavar="X,Y,W,H", help="Object in the first frame of a video that is tracked.")
@click.option("--object", "name", metavar="NAME", help="Object of a recording or run that has several.")
@click.option("--source", metavar="PATH", help="Video of a recording or run, if it has moved since.")
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("summary.html"),
    show_default=True,
    metavar="FILE",
    help="Contact sheet; the JSON file is written beside it.",
)
@with_overwrite
@with_given
def summary(
    given: dict[str, object],
    path: Path,
    count: int,
    box: str | None,
    name: str | None,
    source: str | None,
    output: Path,
    overwrite: bool,
) -> None:
    """Choose a few images that represent many, and write a contact sheet.

    PATH is a folder of images and videos, which may have different sizes and
    may be in subfolders, or one video. The k images are chosen that keep most of
    the energy ||A||^2 of the collection, where A has one row of features for each
    image: images that differ from one another and resemble many others. All
    images are read once, and memory does not grow with their number. Files that
    cannot be read are named, skipped and counted.

    With --box, or for a recording or the folder of a run (--state), the k
    frames are chosen that taught the tracker most of the object: those whose rows
    have most energy outside the span of the coreset before. They are spread over
    time. A video with --box and the folder of a run are tracked again for this,
    with 0.3 MB for each frame in a temporary folder. A recording has the features;
    only the pictures are read from its video. The settings are those of the run;
    --settings, --preset and --set apply to a video with --box.

    \b
    Writes
      summary.html  the pictures with their names, and how much each adds
      summary.json  the same without pictures

    \b
    EXAMPLES
      catstream summary photos/ -k 20
      catstream summary walk.mp4 --output walk.html
      catstream summary walk.mp4 --box 120,80,64,48
      catstream summary walk.mcap -k 8
    """
    # Imported here so that --help and the other commands start faster.
    with INTERRUPTS.leaving():
        from catstream.applications.summaries.images import describe  # noqa: F401  this import compiles the kernels
        from catstream.applications.summaries.sheet import json_beside

    _check_output(output, json_beside(output), overwrite)
    console = messages()
    if _is_recording(path):
        _reject("a recording", {"--box": box, _SETTINGS: given})
        sheet = _of_recording(Recording(path), count, name, source, console)
    elif path.is_dir() and Job.is_in(path):
        _reject("the folder of a run", {"--box": box, _SETTINGS: given})
        job = Job.load(path)
        sheet = _of_job(replace(job, source=source or job.source), count, name, console)
    elif box is not None:
        _reject("a video with --box", {"--object": name, "--source": source})
        job = Job(str(path), boxes_by_name(dict([split_name(box)])), settings=Settings.from_values(given))
        sheet = _of_job(job, count, None, console)
    else:
        _reject("images, or a video without --box", {"--object": name, "--source": source, _SETTINGS: given})
        sheet = _of_images(path, count, console)
    with INTERRUPTS.deferred():
        sheet.save(output)
    console.print(f"{sheet.about[0]}\n{output} and {json_beside(output)}")


def _is_recording(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return path.suffix == _RECORDING or file.read(len(MAGIC)) == MAGIC


def _reject(kind: str, options: dict[str, object]) -> None:
    """Raise an error if options were given that do not apply to this kind of PATH."""
    if given := " and ".join(option for option, value in options.items() if value):
        raise click.UsageError(f"{given} cannot be used with {kind}: omit the option, or give another PATH")


def _check_output(output: Path, json: Path, overwrite: bool) -> None:
    if output.suffix.lower() not in {".html", ".htm"}:  # so that no video, image or recording is replaced
        raise SettingsError(f"--output is the contact sheet, got {str(output)!r}: give a name that ends in .html")
    for file in (output, json):
        check_file(file, overwrite=overwrite)


def _of_images(path: Path, count: int, console: Console) -> Sheet:
    from catstream.applications.summaries.collection import Collection, Origin
    from catstream.applications.summaries.images import describe
    from catstream.applications.summaries.selection import RowSelection
    from catstream.applications.summaries.sheet import WIDTH, sheet_of_images
    from catstream.video.image import jpeg

    collection, selection = Collection(path), RowSelection[tuple[Origin, bytes]](count)
    with line_of(console) as progress, one_thread():
        task = progress.add_task("reading files", total=None)
        for origin, image in collection:
            selection.add(describe(image), (origin, jpeg(image, WIDTH)))
            progress.update(
                task,
                total=len(collection.names),
                completed=collection.opened,
                description=f"{selection.count} images read",
            )
        for reason in collection.skipped:
            console.print(f"skipped {reason}", style="yellow")
        return sheet_of_images(path.resolve().name, collection, selection.result())


def _of_job(job: Job, count: int, name: str | None, console: Console) -> Sheet:
    with tempfile.TemporaryDirectory(prefix="catstream-summary-") as folder:
        return _of_recording(_tracked(job, name, Path(folder), console), count, name, job.source, console)


def _tracked(job: Job, name: str | None, folder: Path, console: Console) -> Recording:
    """Track the source of a job, and record it."""
    from catstream.pipeline import Pipeline
    from catstream.video.source import is_live

    if is_live(job.source):
        raise VideoError("a live source cannot be tracked again: record it with `catstream track --record`")
    given = [*job.boxes, *job.models]
    if not given or name not in (None, *given):
        raise SettingsError(
            f"the objects at the start of this run are: {listed(given)}; "
            "for one that was added by a command, record the run with `catstream track --record`"
        )
    file = folder / f"run{_RECORDING}"
    with (
        Pipeline(job.source, job.boxes, job.settings, model=job.models, part=job.part, record=file) as pipeline,
        line_of(console) as progress,
    ):
        task = progress.add_task("tracking frames", total=None)
        for track in pipeline:
            progress.update(task, total=pipeline.frames, completed=track.frame + 1)
    return Recording(file)


def _of_recording(recording: Recording, count: int, name: str | None, source: str | None, console: Console) -> Sheet:
    from catstream.applications.summaries.sheet import pictures_of, sheet_of_frames
    from catstream.applications.summaries.taught import most_taught, taught_frames

    require_features(recording, incomplete=True)
    settings, source = recording.settings, source or _source_of(recording)
    with line_of(console) as progress, one_thread():
        frames = progress.track(recording.features(), recording.counts[Features], description="comparing frames")
        objects = taught_frames(frames, settings.coreset)
    measured = objects[_object_of(list(objects), name)]
    chosen, pictures = most_taught(measured, count), dict[int, bytes]()
    try:
        if not source:
            raise VideoError("the recording does not name its video, give it with --source")
        with console.status(f"reading {source}"):
            pictures = pictures_of(chosen, source, settings.run.image_rate)
    except VideoError as error:
        console.print(f"the sheet has no pictures: {error}", style="yellow")
    return sheet_of_frames(Path(source or recording.path).stem, chosen, len(measured), source, pictures)


def _source_of(recording: Recording) -> str:
    """Return the source that the detector reported; empty if the recording does not name it."""
    reports = (message for _, message in recording.messages() if isinstance(message, Health))
    return next((report.source for report in reports if report.source), "")


def _object_of(objects: list[str], name: str | None) -> str:
    """Return the name of the object that is summarised."""
    if name is not None and name in objects:
        return name
    if name is None and len(objects) == 1:
        return objects[0]
    raise ObjectError(f"the objects of this run are: {listed(objects)}; give one of them with --object NAME")
