"""`catstream demo`: track the object of a rendered video."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from catstream.cli.common import line_of, messages
from catstream.cli.track import track
from catstream.services.options import PATH


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
    from catstream.applications.evaluation.scores import score
    from catstream.sinks.track_log import read_frames
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
    tracked = [frame.tracks[0].box for frame, _ in read_frames(tracks / "demo.ndjson")]
    found = np.array([box or (np.nan,) * 4 for box in tracked])
    absent, nothing = np.isnan(truth).any(axis=1), np.isnan(found).any(axis=1)
    click.echo(f"success rate: {score(found, truth).success:.3f} (overlap with the ground truth above 0.5)")
    if absent.any():
        click.echo(f"absence reported: {(absent & nothing).sum()} of {absent.sum()} frames")
    click.echo(f"annotated video: {tracks / 'demo.mp4'}")
