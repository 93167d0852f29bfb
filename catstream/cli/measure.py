"""`catstream evaluate` and `demo`: the accuracy of trackers, and a first video."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.table import Table

from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.cli.common import (
    INTERRUPTS,
    complain,
    line_of,
    messages,
    screen,
    stopped,
    table,
    with_json_file,
    write_json,
)
from catstream.cli.options import PATH, with_settings
from catstream.errors import CatstreamError

if TYPE_CHECKING:
    from catstream.evaluation.accuracy import Row
    from catstream.evaluation.datasets import Sequence


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=PATH)
@click.option("--tracker", "trackers", default="catstream", show_default=True, help="Comma-separated list of trackers.")
@click.option("--starts", type=click.IntRange(min=1), help="Start from N frames of each sequence (TRE).")
@click.option("--shifts", is_flag=True, help="Start from 12 shifted or scaled initial boxes (SRE).")
@click.option("--jitter", type=click.IntRange(min=1), help="Start from K initial boxes that differ by at most 2 %.")
@click.option("--keyframes", type=click.IntRange(min=1), help="Annotate with up to N boxes from the ground truth.")
@click.option("--attributes", type=PATH, help="JSON file with attributes, {sequence: [attribute]}.")
@click.option("--peer-models", type=PATH, help="Folder with the model files of nano, nano-v3 and vit.")
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Number of worker processes.")
@click.option("--output", type=PATH, help="Output folder for the results and report.html.")
@with_json_file
@with_settings
def evaluate(
    settings: Settings,
    paths: tuple[Path, ...],
    trackers: str,
    starts: int | None,
    shifts: bool,
    jitter: int | None,
    keyframes: int | None,
    attributes: Path | None,
    peer_models: Path | None,
    jobs: int,
    output: Path | None,
    json_file: Path | None,
) -> None:
    """Measure the accuracy of trackers on annotated sequences.

    PATH is a sequence or a folder of sequences. A sequence is a folder with
    images or one video, and a text file with the box of the object in each
    frame: groundtruth_rect.txt (x,y,w,h; nan if the object is absent). The
    layouts of OTB, LaSOT, GOT-10k, TLD, VOT and Princeton are supported, with
    their flags of absence.

    \b
    TRACKERS
      catstream        single-process tracker
      mil              OpenCV's, always available
      csrt, kcf, tld   OpenCV's, with pip install ".[peers]"
      nano, vit        OpenCV's NanoTrackV2 and VitTrack, with --peer-models FOLDER
      nano-v3          NanoTrackV3, with --peer-models FOLDER

    \b
    METRICS, over the frames with the object
      AUC              area under the success plot: IoU at all thresholds
      success          share of frames with an IoU above 0.5
      precision        share of frames with a centre error of at most 20 pixels
      norm. precision  the same, normalised by the size of the object
      F                F-score of VOT-LT, if the object is absent in some frames
      absence noticed  frames without the object for which no box is reported
      falsely absent   frames with the object for which no box is reported

    --starts, --shifts and --jitter run each sequence several times and print
    means and standard deviations. With --output, results are stored in the
    layouts of the got10k and VOT toolkits, complete runs are not repeated, and
    report.html shows plots. With --attributes, the report and --json include
    means by attribute.

    --keyframes N measures catstream annotate: after a first box, boxes are drawn
    from the ground truth in the frames that it asks for. Printed for 1, 2 ... N
    boxes are the share of right frames (overlap above 0.5, or rightly absent),
    of checked frames, and of right ones among these; the expected share of right
    frames; sequences that are complete, at least 95 % right and expected to be;
    and the success of linear interpolation and of tracking forwards only.

    \b
    EXAMPLES
      catstream evaluate sequences/
      catstream evaluate sequences/ --tracker catstream,csrt --jobs 4 --output results
      catstream evaluate sequences/walk --jitter 7 --set coreset.size=128
      catstream evaluate sequences/ --keyframes 8 --jobs 4 --json keyframes.json
    """
    with INTERRUPTS.leaving():
        from catstream.evaluation import accuracy, datasets, onepass

    if (starts is not None) + shifts + (jitter is not None) + (keyframes is not None) > 1:
        raise click.UsageError("--starts, --shifts, --jitter and --keyframes are mutually exclusive")
    if keyframes is not None and (trackers != "catstream" or output is not None or attributes is not None):
        raise click.UsageError("--keyframes and --tracker, --output or --attributes are mutually exclusive")
    if attributes is not None and output is None and json_file is None:
        raise click.UsageError("--attributes requires --output or --json")
    names = [name.strip() for name in trackers.split(",") if name.strip()]
    errors: list[CatstreamError] = []
    sequences = datasets.find_sequences(*paths, failed=errors.append)
    if keyframes is not None:
        _evaluate_keyframes(sequences, keyframes, settings, jobs, json_file, errors)
        return
    by_sequence = {} if attributes is None else datasets.read_attributes(attributes)

    try:
        with line_of(messages()) as progress:
            task = progress.add_task("starting", total=None)
            runs = onepass.evaluate(
                sequences,
                names,
                settings,
                starts=datasets.choose_starts(starts, jitter, shifts=shifts),
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
        raise CatstreamError("all runs failed: see above")
    rows = accuracy.rows_of(runs)
    screen().print(_table(rows, accuracy.mean_of(rows)))
    for line in accuracy.describe_flips(rows):
        click.echo(line)
    if json_file is not None or output is not None:
        write_json(json_file, accuracy.to_json(rows, settings, by_sequence))
        if output is not None:
            click.echo(f"report: {accuracy.write_report(output / 'report.html', runs, settings, by_sequence, errors)}")
    if errors:
        raise CatstreamError(
            f"{len(errors)} of {len(errors) + len(runs)} runs failed and are not included in the results"
        )


def _evaluate_keyframes(
    sequences: list[Sequence],
    most: int,
    settings: Settings,
    jobs: int,
    json_file: Path | None,
    errors: list[CatstreamError],
) -> None:
    """Measure annotation; print the means by number of boxes, and the boxes of each sequence until it is complete."""
    with INTERRUPTS.leaving():
        from catstream.evaluation import keyframes
        from catstream.reports.provenance import provenance

    with line_of(messages()) as progress:
        task = progress.add_task("starting", total=len(sequences))
        rows = keyframes.evaluate_keyframes(
            sequences,
            most,
            settings,
            jobs=jobs,
            done=lambda rows: progress.update(task, advance=1, description=rows[0].name),
            failed=errors.append,
        )
    for error in errors:
        complain(error)
    if not rows:
        raise CatstreamError("all sequences have failed: see above")
    means, counts = keyframes.mean_by_boxes(rows), keyframes.boxes_until_complete(rows)
    made = table("boxes", *keyframes.MEASURES.values(), right=("boxes", *keyframes.MEASURES.values()))
    for row in means:
        values = (getattr(row, measure) for measure in keyframes.MEASURES)
        made.add_row(str(row.boxes), *("-" if value is None else f"{value:.3f}" for value in values))
    screen().print(made)
    completed = [count for count in counts.values() if count is not None]
    mean = f", with {sum(completed) / len(completed):.1f} boxes on average" if completed else ""
    click.echo(f"{len(completed)} of {counted(len(counts), 'sequence')} complete{mean}")
    figures = {"rows": [asdict(row) for row in rows], "mean": [asdict(row) for row in means], "complete": counts}
    write_json(json_file, {**provenance(settings), **figures})
    if errors:
        raise CatstreamError(f"{len(errors)} sequences have failed and are not included in the figures")


def _table(rows: list[Row], means: dict[str, dict[str, float | None]]) -> Table:
    from catstream.evaluation.accuracy import HEADINGS, cells

    numbers = ("frames", *HEADINGS)
    output = table("sequence", "tracker", *numbers, right=numbers)
    for row in rows:
        output.add_row(row.name, row.tracker, str(row.frames), *cells(row))
    output.add_section()
    for tracker, mean in means.items():
        output.add_row("mean", tracker, "", *cells(mean), style="bold")
    return output


@click.command()
@click.option("--output", type=PATH, default=Path("demo"), show_default=True, help="Folder.")
@click.option("--frames", type=click.IntRange(min=2), default=600, show_default=True, help="Length of the video.")
@click.option("--render-only", is_flag=True, help="Only write the video and its ground truth.")
@click.option("--live", metavar="demo:SEED", help="Only print the box of the first frame of this live source.")
def demo(output: Path, frames: int, render_only: bool, live: str | None) -> None:
    """Render a video with ground truth, track its object, and print the accuracy.

    A dahlia moves over a lake: it rotates and changes its size, the brightness
    changes, a similar flower crosses it, a pagoda occludes it, and it leaves the
    picture and returns.

    The source demo:SEED is a part of the video as a live source, which needs no
    camera and never ends. SEED is a number. --live prints the box of its first
    frame.

    \b
    Writes
      OUTPUT/demo.mp4, groundtruth_rect.txt   the video and its ground truth: a sequence for `catstream evaluate`
      OUTPUT/tracks/                          the results of `catstream track`, with the annotated video

    \b
    EXAMPLES
      catstream demo
      catstream demo --live demo:1
      catstream track demo:1 --box "$(catstream demo --live demo:1)" --view
    """
    if live is not None:
        from catstream.video.live_demo import first_box

        click.echo(first_box(live))
        return
    with INTERRUPTS.leaving():
        import numpy as np

        from catstream.cli.track import track
        from catstream.evaluation.scores import score
        from catstream.sinks.track_log import Log
        from catstream.video.rendered import write

    with line_of(messages()) as bar:
        task = bar.add_task("rendering", total=frames)
        video, boxes = write(output, frames, done=lambda count: bar.update(task, completed=count))
    click.echo(f"video: {video}")
    if render_only:
        return
    tracks = output / "tracks"
    arguments = [str(video), "--box", str(boxes[0]), "--output", str(tracks), "--video", "--overwrite"]
    track.main(arguments, prog_name="catstream track", standalone_mode=False)
    truth = np.array([box or (np.nan,) * 4 for box in boxes])
    tracked = [frame.tracks[0].box for frame in Log(tracks / "demo.ndjson").frames()]
    result = score(np.array([box or (np.nan,) * 4 for box in tracked]), truth)
    click.echo(f"success rate: {result.success:.3f} (IoU with the ground truth above 0.5)")
    if result.absence.absent:
        click.echo(f"absence reported: {result.absence.noticed} of {result.absence.absent} frames")
    click.echo(f"annotated video: {tracks / 'demo.mp4'}")
