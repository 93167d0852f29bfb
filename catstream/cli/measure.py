"""`catstream evaluate` and `demo`: the accuracy on annotated sequences, and a first video."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.base.settings import Settings
from catstream.cli.common import (
    INTERRUPTS,
    complain,
    line_of,
    messages,
    screen,
    table,
    with_json_file,
    with_report_file,
    write_json,
)
from catstream.cli.options import PATH, with_settings
from catstream.errors import CatstreamError


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=PATH)
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Number of worker processes.")
@with_json_file
@with_report_file
@with_settings
def evaluate(
    settings: Settings, paths: tuple[Path, ...], jobs: int, json_file: Path | None, report_file: Path | None
) -> None:
    """Measure the accuracy on annotated sequences.

    PATH is a sequence or a folder of sequences. A sequence is a folder with
    images or one video, and a text file with the box of the object in each
    frame: groundtruth_rect.txt (x,y,w,h; nan if the object is absent). The
    layouts of OTB, LaSOT, GOT-10k, TLD, VOT and Princeton are supported, with
    their flags of absence. Each sequence is tracked once, from its first box to
    its end.

    \b
    METRICS, over the frames with the object
      AUC              area under the success plot: IoU at all thresholds
      success          share of frames with an IoU above 0.5
      precision        share of frames with a centre error of at most 20 pixels
      norm. precision  the same, normalised by the size of the object
      absence noticed  frames without the object for which no box is reported
      falsely absent   frames with the object for which no box is reported

    \b
    EXAMPLES
      catstream evaluate sequences/
      catstream evaluate sequences/ --jobs 4 --report accuracy.html --json accuracy.json
      catstream evaluate sequences/walk --set coreset.size=128
    """
    with INTERRUPTS.leaving():
        from catstream.measure.accuracy import HEADINGS, Row, to_json, write_report
        from catstream.measure.datasets import find_sequences
        from catstream.measure.onepass import Run, evaluate

    errors: list[CatstreamError] = []
    sequences = find_sequences(*paths, failed=errors.append)
    with line_of(messages()) as progress:
        task = progress.add_task("starting", total=sum(map(len, sequences)))

        def show(run: Run) -> None:
            progress.update(task, advance=len(run.sequence), description=run.sequence.name)

        runs = evaluate(sequences, settings, jobs=jobs, done=show, failed=errors.append)
    for error in errors:
        complain(error)
    if not runs:
        raise CatstreamError("all sequences failed: see above")
    rows = [Row.of(run) for run in runs]
    output = table("sequence", "frames", *HEADINGS, right=("frames", *HEADINGS))
    for row in rows:
        output.add_row(*row.cells())
    output.add_section()
    output.add_row(*Row.mean(rows).cells(), style="bold")
    screen().print(output)
    write_json(json_file, to_json(rows, settings))
    if report_file is not None:
        click.echo(f"report: {write_report(report_file, runs, settings, errors)}")
    if errors:
        raise CatstreamError(
            f"{len(errors)} of {len(errors) + len(runs)} sequences failed and are not included in the results"
        )


@click.command()
@click.option("--output", type=PATH, default=Path("demo"), show_default=True, help="Folder.")
@click.option("--frames", type=click.IntRange(min=2), default=600, show_default=True, help="Length of the video.")
@click.option("--render-only", is_flag=True, help="Only write the video and its ground truth.")
@click.option("--live", metavar="demo:SEED", help="Only print the box of the first frame of this live source.")
def demo(output: Path, frames: int, render_only: bool, live: str | None) -> None:
    """Render a video with ground truth, track its object, and print the accuracy.

    The source demo:SEED is a part of the video as a live source, which needs no
    camera and never ends. SEED is a number. --live prints the box of its first
    frame.

    \b
    OUTPUT
      demo.mp4, groundtruth_rect.txt  a sequence for `catstream evaluate`
      tracks/                         the results of `catstream track`

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
        from catstream.measure.scores import score
        from catstream.output.track_log import Log
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
    tracked = [frame.tracks[0].box for frame in Log(tracks / "demo.ndjson")]
    result = score(np.array([box or (np.nan,) * 4 for box in tracked]), truth)
    click.echo(f"success rate: {result.success:.3f} (IoU with the ground truth above 0.5)")
    if result.absent:
        click.echo(f"absence reported: {result.noticed} of {result.absent} frames")
    click.echo(f"annotated video: {tracks / 'demo.mp4'}")
