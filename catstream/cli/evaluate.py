"""`catstream evaluate`: measure the accuracy of trackers on annotated sequences."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.progress import Task
from rich.table import Table

from catstream.cli.files import with_json_file, write_json
from catstream.cli.interrupts import INTERRUPTS, stopped
from catstream.cli.output import complain, line_of, messages, screen, table
from catstream.errors import CatstreamError
from catstream.services.options import PATH, with_settings
from catstream.settings import Settings

if TYPE_CHECKING:
    from catstream.applications.evaluation.summary import Row


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=PATH)
@click.option("--tracker", "trackers", default="catstream", show_default=True, help="Comma-separated; see above.")
@click.option("--starts", type=click.IntRange(min=1), help="Run from N frames of each sequence (TRE).")
@click.option("--shifts", is_flag=True, help="Run from 12 shifted or scaled first boxes (SRE).")
@click.option("--jitter", type=click.IntRange(min=1), help="Run from K first boxes that differ by at most 2 %.")
@click.option("--attributes", type=PATH, help="JSON file {sequence: [attribute]}.")
@click.option("--peer-models", type=PATH, help="Folder of model files for nano and vit.")
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Number of processes.")
@click.option("--output", type=PATH, help="Folder for results and report.html.")
@with_json_file
@with_settings
def evaluate(
    settings: Settings,
    paths: tuple[Path, ...],
    trackers: str,
    starts: int | None,
    shifts: bool,
    jitter: int | None,
    attributes: Path | None,
    peer_models: Path | None,
    jobs: int,
    output: Path | None,
    json_file: Path | None,
) -> None:
    """Measure trackers on annotated sequences.

    PATH is a sequence or a folder of sequences. A sequence is a folder with
    images or one video, and a text file with the box of the object in each
    frame: groundtruth_rect.txt (x,y,w,h; nan if the object is absent). The
    layouts of OTB, TLD, VOT and Princeton can be read.

    \b
    TRACKERS
      catstream        this one, in one process
      mil              OpenCV's, always available
      csrt, kcf, tld   OpenCV's, with pip install "catstream[peers]"
      nano, vit        OpenCV's NanoTrack and VitTrack, with --peer-models FOLDER:
                       nanotrack_backbone_sim.onnx, nanotrack_head_sim.onnx and
                       object_tracking_vittrack_2023sep.onnx, which are not included

    \b
    MEASURES, over the frames with the object
      AUC        area under the success plot: overlap with the ground truth, all thresholds
      success    share of frames with an overlap above 0.5
      precision  share of frames whose centre is at most 20 pixels off
      norm.      normalised precision: the same, relative to the size of the object
      F          F-score of VOT-LT, if the object is absent in some frames

    On difficult sequences a single run varies much. One of these options makes
    several runs of each sequence; mean and standard deviation are printed:

    \b
      --starts 5   from five frames: temporal robustness (TRE)
      --shifts     from 12 first boxes: moved by 10 % in eight directions, and of
                   0.8, 0.9, 1.1 and 1.2 times the size: spatial robustness (SRE)
      --jitter 7   from the first box and six others within 2 %; a sequence flips
                   if its success differs by more than 0.25 between them

    With --output, results are stored in the layouts of the got10k and VOT
    toolkits, complete runs are not repeated, and report.html shows plots and
    the worst failures.

    The report and --json also have the means over the sequences with fast motion,
    scale variation, aspect change, low resolution, or an object out of view, as
    the ground truth shows, and over those with an attribute from the file
    of --attributes.

    \b
    EXAMPLES
      catstream evaluate sequences/
      catstream evaluate sequences/ --tracker catstream,csrt --jobs 4 --output results
      catstream evaluate sequences/walk --jitter 7 --set coreset.size=128
    """
    # Imported here so that --help and the other commands start faster.
    with INTERRUPTS.leaving():
        from catstream.applications.evaluation.attributes import attributes_of, read_attributes
        from catstream.applications.evaluation.datasets import find_sequences
        from catstream.applications.evaluation.onepass import evaluate as run_all
        from catstream.applications.evaluation.report import write_report
        from catstream.applications.evaluation.starts import choose_starts
        from catstream.applications.evaluation.summary import describe_flips, mean_of, rows_of, to_json

    if (starts is not None) + shifts + (jitter is not None) > 1:
        raise click.UsageError("--starts, --shifts and --jitter each choose the runs of a sequence: give one of them")
    if attributes is not None and output is None and json_file is None:
        raise click.UsageError("--attributes adds rows to the report and to the JSON file: give --output or --json")
    names = [name.strip() for name in trackers.split(",") if name.strip()]
    sequences = [sequence for path in paths for sequence in find_sequences(path)]
    seen = {} if attributes is None else read_attributes(attributes)

    errors: list[CatstreamError] = []
    try:
        with line_of(messages(), _line) as progress:
            task = progress.add_task("starting", total=None)
            runs = run_all(
                sequences,
                names,
                settings,
                starts=choose_starts(starts, jitter, shifts=shifts),
                peer_models=peer_models,
                jobs=jobs,
                output=output,
                begin=lambda frames: progress.update(task, total=frames),
                done=lambda run: progress.update(task, advance=len(run.boxes), description=f"{run.tracker} {run.name}"),
                failed=errors.append,
            )
    except KeyboardInterrupt:
        stopped("" if output is None else f"complete runs are in {str(output)!r}; the same command continues")

    for error in errors:
        complain(error)
    if not runs:
        raise CatstreamError("all runs have failed: see above")
    rows = rows_of(runs)
    screen().print(_table(rows, mean_of(rows)))
    for line in describe_flips(rows):
        click.echo(line)
    if json_file is not None or output is not None:
        shared = attributes_of({run.sequence.name: run.sequence for run in runs}.values(), seen)
        write_json(json_file, to_json(rows, settings, shared))
        if output is not None:
            click.echo(f"report: {write_report(output / 'report.html', runs, settings, shared)}")
    if errors:
        raise CatstreamError(
            f"{len(errors)} of {len(errors) + len(runs)} runs have failed and are not included in the figures"
        )


def _line(task: Task) -> list[str]:
    """Tracker and run, frames, and the time that is left."""
    left = [] if task.time_remaining is None else [f"{timedelta(seconds=round(task.time_remaining))} left"]
    return [task.description, f"{task.completed:.0f}/{task.total or 0:.0f} frames", *left]


def _table(rows: list[Row], means: dict[str, dict[str, float | None]]) -> Table:
    """Return a table of the sequences and the means."""
    from catstream.applications.evaluation.summary import MEASURES, cells

    numbers = ("frames", *MEASURES.values())
    made = table("sequence", "tracker", *numbers, right=numbers)
    for row in rows:
        made.add_row(row.name, row.tracker, str(row.frames), *cells(row))
    made.add_section()
    for tracker, mean in means.items():
        made.add_row("mean", tracker, "", *cells(mean), style="bold")
    return made
