"""`catstream find` and `merge`: search videos for the objects of saved models, and merge saved models."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import click

from catstream.base.files import check_file
from catstream.base.text import counted
from catstream.base.threads import one_thread
from catstream.cli.common import INTERRUPTS, complain, line_of, messages, screen, stopped, table, text
from catstream.cli.options import PATH, NumberRange, with_overwrite
from catstream.client.saved_model import SavedModel
from catstream.client.saved_model import merge as merged
from catstream.errors import CatstreamError, VideoError

if TYPE_CHECKING:
    from catstream.offline.find_results import Interval

_PRINTED = 12  # intervals that are printed


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=PATH)
@click.option(
    "--model", "models", type=PATH, multiple=True, required=True, metavar="FILE", help="Saved model; repeatable."
)
@click.option("--output", type=PATH, default="detections", show_default=True, help="Output folder.")
@with_overwrite
@click.option(
    "--threshold", type=NumberRange(0, 2), default=0.5, show_default=True, help="Minimum score of a detection."
)
@click.option(
    "--every", type=NumberRange(0, 3600), default=0.2, show_default=True, help="Seconds of a video between two frames."
)
def find(
    paths: tuple[Path, ...], models: tuple[Path, ...], output: Path, overwrite: bool, threshold: float, every: float
) -> None:
    """Find the objects of saved models in videos, folders and images.

    PATH is a video, an image, or a folder, which is searched recursively. Videos
    are sampled every 0.2 s (--every; 0 searches every frame). The images of a
    folder are treated as one sequence. A file that was searched is not searched
    again, so after Ctrl-C the same command continues. The exit status is 1 if a
    file is damaged or could not be read.

    \b
    OUTPUT FILES
      report.html     a picture of the best detection in each interval
      detections.csv  a row for each detection: file, object, frame, time, box, score
      results.ndjson  a line for each searched file: intervals, problems

    The score is about 1 on the object. Raise --threshold if there are false
    positives; lower it, or train on more frames, if the object is missed.

    \b
    EXAMPLES
      catstream track walk.mp4 --box 120,80,64,48 --save-model anna.safetensors
      catstream find --model anna.safetensors --model ben.safetensors videos/ photos/
    """
    with INTERRUPTS.leaving():
        from catstream.offline.find import Search, load_models
        from catstream.offline.find_files import find_files
        from catstream.offline.find_results import FileResult, SearchResults, write_detections, write_report
        from catstream.output.report import clock

    # Step 1: search each file that has no result yet, and store its result.
    search = Search(load_models(models), threshold, every)
    files = find_files(paths)
    columns = text("file {task.completed}/{task.total}  {task.fields[position]}  {task.description}", last=True)
    interrupted = False
    with SearchResults(output, search.digest, overwrite=overwrite) as results:
        try:
            with one_thread(opencv=True), line_of(messages(), columns) as progress:
                task = progress.add_task("", total=len(files), position="")
                for number, file in enumerate(files):
                    if results.has(file):
                        continue
                    result = FileResult.of(file, search.digest, every)
                    try:
                        for frame, detections in search.file(file, result.problems):
                            result.add(frame, detections)
                            position = f"{clock(frame.time)}, {counted(len(result.intervals), 'interval')}"
                            progress.update(task, completed=number, description=file.path.name, position=position)
                    except VideoError as error:
                        result.problems.append(str(error))
                    with INTERRUPTS.deferred():
                        results.add(result)
        except KeyboardInterrupt:
            interrupted = True
        # Step 2: write the report about all results, even after Ctrl-C.
        with INTERRUPTS.deferred():
            searched = list(results.files.values())
            intervals = [interval for result in searched for interval in result.intervals]
            write_detections(output / "detections.csv", intervals)
            intervals.sort(key=lambda interval: -interval.best.score)
            report = write_report(output / "report.html", search.models, searched, intervals)

    _print(intervals)
    click.echo(f"report: {report}" if intervals else f"no detections; report: {report}")
    if interrupted:
        stopped("the results of the searched files are saved; the same command continues")
    problems = [problem for result in searched for problem in result.problems]
    for problem in problems:
        complain(problem)
    if problems:
        raise CatstreamError(
            f"{counted(len(problems), 'problem')} in {counted(len(files), 'file')}: all other content was searched"
        )


def _print(intervals: list[Interval]) -> None:
    from catstream.output.report import clock

    numbers = ("from", "to", "detections", "score")
    best = table("object", "file", *numbers, right=numbers)
    for interval in intervals[:_PRINTED]:
        figures = (*map(clock, interval.times), str(len(interval.detections)), f"{interval.best.score:.2f}")
        best.add_row(interval.best.object, interval.best.file, *figures)
    if intervals:
        screen().print(best)
    if len(intervals) > _PRINTED:
        click.echo(f"and {len(intervals) - _PRINTED} more intervals")


@click.command()
@click.argument("files", nargs=-1, required=True, type=PATH, metavar="FILE...")
@click.option("-o", "--output", required=True, type=PATH, metavar="FILE", help="File to write.")
@with_overwrite
@click.option("--force", is_flag=True, help="Merge models even if their objects look different.")
def merge(files: tuple[Path, ...], output: Path, overwrite: bool, force: bool) -> None:
    """Merge saved models of one object, for example from two cameras.

    The coreset trees are merged, and a model is trained from them. Its scores are
    within the error bound of the coreset as if one tree had seen all videos.
    The files must have the same object and settings, and no frames in common.
    Models of dissimilar objects are rejected, or merged with a warning.

    \b
    EXAMPLES
      catstream merge door.safetensors yard.safetensors -o anna.safetensors
    """
    check_file(output, overwrite=overwrite)
    parts = [SavedModel.load(file) for file in files]
    with warnings.catch_warnings(record=True, action="always", category=UserWarning) as doubts:
        whole = merged(parts, force=force)
    for doubt in doubts:
        complain(f"warning: {doubt.message}")
    whole.save(output)
    tree = whole.trees["object"]
    click.echo(
        f"{output}: {len(files)} saved models, {len(whole.origins)} videos, {tree.rows_seen} rows of the object in "
        f"{len(tree.nodes)} nodes"
    )
