"""`catstream demo`: track an object in a rendered video."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from catstream.cli.track import track

__all__ = ["demo"]


@click.command()
@click.option("--output", type=click.Path(path_type=Path), default=Path("demo"), show_default=True, help="Folder.")
@click.option("--frames", type=click.IntRange(min=2), default=600, show_default=True, help="Length of the video.")
@click.option("--render-only", is_flag=True, help="Only write the video and its ground truth.")
def demo(output: Path, frames: int, render_only: bool) -> None:
    """Render a video with ground truth, track the object in it, and print the accuracy.

    A dahlia moves over a lake: it rotates and changes its size, the brightness
    changes, a similar flower crosses it, a pagoda occludes it, and it leaves the
    picture and returns.

    \b
    Writes
      OUTPUT/demo.mp4, groundtruth_rect.txt   the video and its ground truth: a sequence for `catstream evaluate`
      OUTPUT/tracks/                          the results of `catstream track`, with the annotated video
    """
    from catstream.evaluation.metrics import score
    from catstream.video.demo import write

    console = Console()
    with Progress(TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), console=console, transient=True) as bar:
        task = bar.add_task("", total=frames)
        video, boxes = write(output, frames, done=lambda count: bar.update(task, completed=count))
    console.print(f"video: {video}", soft_wrap=True)
    if render_only:
        return

    tracks = output / "tracks"
    arguments = [str(video), "--box", str(boxes[0]), "--output", str(tracks), "--video", "--overwrite"]
    track.main(arguments, prog_name="catstream track", standalone_mode=False)

    truth = np.array([box or (np.nan,) * 4 for box in boxes])
    found = np.loadtxt(tracks / "demo.txt", delimiter=",", ndmin=2)
    absent, nothing = np.isnan(truth).any(axis=1), np.isnan(found).any(axis=1)
    console.print(f"success rate: {score(found, truth).success:.3f} (overlap with the ground truth above 0.5)")
    if absent.any():
        console.print(f"absence reported: {(absent & nothing).sum()} of {absent.sum()} frames")
    console.print(f"annotated video: {tracks / 'demo.mp4'}", soft_wrap=True)
