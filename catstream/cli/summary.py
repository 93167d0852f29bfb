"""`catstream summary`: choose the images that represent a collection, or the frames that taught the tracker most."""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from catstream.box import Box
from catstream.cli import interruptible
from catstream.cli.interrupts import Interrupts
from catstream.errors import CatstreamError, SettingsError, VideoError
from catstream.services.options import with_settings
from catstream.settings import Settings

if TYPE_CHECKING:
    from catstream.job import Job
    from catstream.recording.file import Recording
    from catstream.summaries.sheet import Picture

__all__ = ["summary"]

_RECORDING = ".mcap"


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@click.option("-k", "count", type=click.IntRange(1), default=12, show_default=True, help="Number of images or frames.")
@click.option("--box", metavar="X,Y,W,H", help="Object in the first frame of a video: the frames that taught most.")
@click.option("--source", metavar="PATH", help="Video of a recording, if it has moved since.")
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("summary.html"),
    show_default=True,
    metavar="FILE",
    help="Contact sheet; the JSON file is written beside it.",
)
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
@with_settings
def summary(
    settings: Settings, path: Path, count: int, box: str | None, source: str | None, output: Path, overwrite: bool
) -> None:
    """Choose a few images that represent many, and write a contact sheet.

    PATH is a folder of images and videos, which may have different sizes and
    may be in subfolders, or one video. The k images are chosen that keep most of
    the energy ||A||^2 of the collection, where A has one row of features for each
    image: images that differ from one another and resemble many others. All
    images are read once, and memory does not grow with their number. Files that
    cannot be read are named, skipped and counted.

    With --box, or for a recording (.mcap) or the folder of a run (--state), the k
    frames are chosen that taught the tracker most of the object: those whose rows
    have most energy outside the span of the coreset before. They are spread over
    time. A video with --box and the folder of a run are tracked again for this,
    with 0.4 MB for each frame in a temporary folder. A recording has the features;
    only the pictures are read from its video.

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
    with interruptible():
        from catstream.job import Job
        from catstream.recording.file import Recording

    _check_output(output, overwrite)
    interrupts, console = Interrupts(), Console(stderr=True, soft_wrap=True, highlight=False)
    interrupts.install()
    with ExitStack() as stack:
        if path.suffix == _RECORDING:
            result = _of_recording(Recording(path), count, source, console)
        elif box is not None or (path.is_dir() and Job.is_in(path)):
            job = Job(str(path), Box.parse(box), settings=settings) if box is not None else Job.load(path)
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="catstream-summary-"))
            result = _of_recording(_tracked(job, Path(folder), console), count, source or job.source, console)
        else:
            result = _of_images(path, count, console)
        with interrupts.deferred():
            _write(output, *result)
    console.print(f"{result[1][0]}\n{output} and {output.with_suffix('.json')}")


_Result = tuple[str, list[str], "list[Picture]", dict[str, Any]]  # title, paragraphs, pictures, and figures for JSON


def _check_output(output: Path, overwrite: bool) -> None:
    if output.suffix == ".json":
        raise SettingsError(f"--output is the contact sheet, got {str(output)!r}: give a name that ends in .html")
    if not output.absolute().parent.is_dir():
        raise VideoError(f"cannot write {str(output)!r}: its folder does not exist, make it first")
    for file in (output, output.with_suffix(".json")):
        if file.exists() and not overwrite:
            raise VideoError(f"{str(file)!r} exists: give another --output, or --overwrite to replace it")


def _of_images(path: Path, count: int, console: Console) -> _Result:
    from catstream.summaries.collection import Collection, Origin
    from catstream.summaries.images import describe
    from catstream.summaries.pictures import WIDTH
    from catstream.summaries.selection import RowSelection
    from catstream.summaries.sheet import Picture
    from catstream.threads import one_thread
    from catstream.video.preview import jpeg

    collection, selection = Collection(path), RowSelection[tuple[Origin, bytes]](count)
    columns = TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("files")
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress, one_thread():
        task = progress.add_task("reading", total=len(collection.files))
        for origin, image in collection:
            selection.add(describe(image), (origin, jpeg(image, WIDTH)))
            progress.update(task, completed=collection.opened, description=f"{selection.count} images")
        for reason in collection.skipped:
            console.print(f"skipped {reason}", style="yellow")
        found = selection.selected()
    chosen = sorted(found.rows, key=lambda row: (collection.place(row.key[0]), row.key[0].frame or 0))
    skipped = f"; {len(collection.skipped)} skipped" * bool(collection.skipped)
    about = [
        f"{count} of {found.count} images keep {100 * found.kept:.1f} % of the energy of all{skipped}.",
        "An image adds the energy that the chosen images which add more do not keep already.",
    ]
    pictures = [
        Picture(row.key[1], row.key[0].file, f"{_moment(row.key[0])}adds {100 * row.energy:.2f} %") for row in chosen
    ]
    figures = {
        "images": found.count,
        "kept": found.kept,
        "kept_at_most": found.kept_at_most,
        "skipped": collection.skipped,
        "chosen": [asdict(row.key[0]) | {"energy": row.energy} for row in chosen],
    }
    return f"Summary of {path.resolve().name}", about, pictures, figures


def _moment(origin: Any) -> str:
    return "" if origin.time is None else f"{origin.time:.2f} s, frame {origin.frame}; "


def _tracked(job: Job, folder: Path, console: Console) -> Recording:
    """Track the source of a job, and record it."""
    from catstream.pipeline import Pipeline
    from catstream.recording.file import Recording
    from catstream.video.source import is_live

    if is_live(job.source):
        raise VideoError(
            f"{job.source!r} is a live source: record it with `catstream track --record`, and summarise that"
        )
    file = folder / f"run{_RECORDING}"
    columns = TextColumn("tracking"), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("frames")
    with (
        Pipeline(job.source, job.box, job.settings, model=job.model, part=job.part, record=file) as pipeline,
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress,
    ):
        task = progress.add_task("", total=pipeline.frames)
        for _ in pipeline:
            progress.advance(task)
    return Recording(file)


def _of_recording(recording: Recording, count: int, source: str | None, console: Console) -> _Result:
    from catstream.messages import Features
    from catstream.recording.learning import require_features
    from catstream.summaries.pictures import pictures_of, source_of
    from catstream.summaries.sheet import Picture
    from catstream.summaries.taught import most_taught, taught_frames
    from catstream.threads import one_thread

    require_features(recording, incomplete=True)
    settings = recording.settings
    columns = TextColumn("comparing"), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("frames")
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress, one_thread():
        task = progress.add_task("", total=recording.counts[Features])
        measured = taught_frames(recording.features(), settings.coreset, lambda: progress.advance(task))
    chosen = most_taught(measured, count)
    source, pictures = source or source_of(recording), dict[int, bytes]()
    try:
        if not source:
            raise VideoError("the recording does not name its video: give it with --source")
        with console.status(f"reading {source}"):
            pictures = pictures_of(chosen, source, settings.run.image_rate)
    except VideoError as error:
        console.print(f"no pictures: {error}", style="yellow")
    about = [
        f"The {count} of {len(measured)} frames that taught the tracker most, spread over the run.",
        "New is the share of the energy of the object's rows that the coreset did not span before the frame. The box "
        "is the one that was learned from.",
    ]
    shown = [
        Picture(
            pictures.get(frame.frame), f"frame {frame.frame}", f"{frame.time:.2f} s; {100 * frame.novelty:.1f} % new"
        )
        for frame in chosen
    ]
    figures = {"frames": len(measured), "source": source, "chosen": [asdict(frame) for frame in chosen]}
    return f"Summary of {Path(source or recording.path).stem}", about, shown, figures


def _write(output: Path, title: str, about: list[str], pictures: list[Picture], figures: dict[str, Any]) -> None:
    from catstream.storage import write_atomically
    from catstream.summaries.sheet import write_sheet

    write_sheet(output, title, about, pictures)
    try:
        write_atomically(output.with_suffix(".json"), (json.dumps(figures, indent=1) + "\n").encode())
    except OSError as error:
        raise CatstreamError(f"cannot write {str(output.with_suffix('.json'))!r}: {error.strerror}") from None
