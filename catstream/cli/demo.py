"""`catstream demo`: track the objects of a rendered video."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import click
import numpy as np

from catstream.cli.common import line_of, messages
from catstream.cli.track import track
from catstream.services.options import PATH

Truth = TypeVar("Truth")


@click.command()
@click.option("--output", type=PATH, default=Path("demo"), show_default=True, help="Folder.")
@click.option(
    "--objects", type=click.IntRange(1, 16), default=1, show_default=True, help="How many objects; 8 is a good number."
)
@click.option(
    "--frames", type=click.IntRange(min=2), help="Length of the video.  [default: 600, of several objects 300]"
)
@click.option("--render-only", is_flag=True, help="Only write the video and its ground truth.")
@click.option("--live", metavar="demo:SEED", help="Only print the box of the first frame of this live source.")
def demo(output: Path, objects: int, frames: int | None, render_only: bool, live: str | None) -> None:
    """Render a video with ground truth, track its objects, and print the accuracy.

    A dahlia moves over a lake: it rotates and changes its size, the brightness
    changes, a similar flower crosses it, a pagoda occludes it, and it leaves the
    picture and returns. With --objects, several flowers and other objects with
    names cross and occlude one another.

    The source demo:SEED is a part of the video as a live source, which needs no
    camera and never ends. SEED is a number; demo:SEED?size=640x480&rate=10
    changes the frames. --live prints the box of its first frame.

    \b
    Writes
      OUTPUT/demo.mp4, groundtruth_rect.txt   the video and its ground truth: a sequence for `catstream evaluate`
      OUTPUT/crowd.mp4, groundtruth.txt       with --objects: the same; columns of MOTChallenge, pixels from 0
      OUTPUT/tracks/                          the results of `catstream track`, with the annotated video

    \b
    EXAMPLES
      catstream demo
      catstream demo --objects 8 --output crowd
      catstream demo --live demo:1
      catstream track demo:1 --box "$(catstream demo --live demo:1)" --view
    """
    if live is not None:
        from catstream.video.live_demo import first_box

        click.echo(first_box(live))
    elif objects == 1:
        _one(output, frames, render_only)
    else:
        _several(output, objects, frames, render_only)


def _one(output: Path, frames: int | None, render_only: bool) -> None:
    """The demo with one object."""
    from catstream.applications.evaluation.scores import score
    from catstream.video.demo import FRAMES, write

    frames = frames or FRAMES
    video, boxes = _rendered(frames, lambda done: write(output, frames, done=done))
    if render_only:
        return
    tracks = output / "tracks"
    _track(video, tracks, ["--box", str(boxes[0])])
    truth = np.array([box or (np.nan,) * 4 for box in boxes])
    found = np.loadtxt(tracks / "demo.txt", delimiter=",", ndmin=2)
    absent, nothing = np.isnan(truth).any(axis=1), np.isnan(found).any(axis=1)
    click.echo(f"success rate: {score(found, truth).success:.3f} (overlap with the ground truth above 0.5)")
    if absent.any():
        click.echo(f"absence reported: {(absent & nothing).sum()} of {absent.sum()} frames")
    click.echo(f"annotated video: {tracks / 'demo.mp4'}")


def _several(output: Path, objects: int, frames: int | None, render_only: bool) -> None:
    """The demo with several objects."""
    from catstream.applications.evaluation.scores import score
    from catstream.sinks.formats import CsvSink
    from catstream.video.crowd import FRAMES, write

    frames = frames or FRAMES
    video, truth = _rendered(frames, lambda done: write(output, objects, frames, done=done))
    if render_only:
        return
    tracks = output / "tracks"
    _track(video, tracks, [word for name, box in truth[0].items() for word in ("--box", f"{name}={box}")])
    found = {(track.frame, track.object): track.box for track in CsvSink.tracks(tracks / "crowd.csv")}
    for name in truth[0]:
        boxes = (
            np.array([box or (np.nan,) * 4 for box in each])
            for each in ([found.get((number, name)) for number in range(frames)], [boxes[name] for boxes in truth])
        )
        click.echo(f"success rate of {name}: {score(*boxes).success:.3f}")
    click.echo(f"annotated video: {tracks / 'crowd.mp4'}")


def _rendered(frames: int, write: Callable[[Callable[[int], None]], tuple[Path, Truth]]) -> tuple[Path, Truth]:
    """Render with a progress bar; return the video and its truth."""
    with line_of(messages()) as bar:
        task = bar.add_task("rendering", total=frames)
        video, truth = write(lambda count: bar.update(task, completed=count))
    click.echo(f"video: {video}")
    return video, truth


def _track(video: Path, tracks: Path, boxes: list[str]) -> None:
    """Run `catstream track`, with an annotated video."""
    arguments = [str(video), *boxes, "--output", str(tracks), "--video", "--overwrite"]
    track.main(arguments, prog_name="catstream track", standalone_mode=False)
