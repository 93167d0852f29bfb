"""Measures whether the pipeline slows down or its memory grows over 20,000 frames or more.

TLD_01_david, forwards and backwards again and again, so that nothing jumps. Both medians are over one whole
such turn, so that the same images are compared.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from journey import Journey, draw, travel
from sequences import named, scratch
from table import Table, command, publish

from catstream.applications.evaluation.datasets import Sequence
from catstream.applications.evaluation.metrics import score
from catstream.settings import Settings
from catstream.video.writer import VideoWriter

EARLY = 1_000


def figures(options: argparse.Namespace) -> Iterator[Table]:
    sequence = named(options, "TLD_01_david")
    turn = 2 * len(sequence) - 2
    frames, early = (2 * turn, turn) if options.quick else (options.frames, EARLY)
    order = len(sequence) - 1 - abs(np.arange(frames + turn // 2) % turn - (len(sequence) - 1))
    source = looped(sequence, order)
    journey = travel(str(source), sequence.boxes[0], Settings(), watch=4 if options.quick else 250)
    draw({"": journey}, options.plot)

    before, after = (around(journey, frame, turn) for frame in (early, frames))
    success = score(np.array(journey.boxes), sequence.boxes[order]).success
    columns = ("frames", f"ms around {early}", f"ms around {frames}", "ratio", "frames/s", "success")
    rows = [(len(order), before, after, after / before, journey.rate, success)]
    yield Table("Time a frame", columns, rows, f"medians over {turn} frames; {options.plot} shows all")
    yield Table("Memory", ("process", f"MB at {early}", "MB at the end", "most"), list(memory(journey, early)))


def looped(sequence: Sequence, order: np.ndarray) -> Path:
    """Write a video of the frames of a sequence in a given order."""
    images = list(sequence.frames())
    height, width = images[0].shape[:2]
    path = scratch() / "loop.mp4"
    with VideoWriter(path, 25, (width, height)) as video:
        for number in order:
            video.write(images[number])
    return path


def around(journey: Journey, frame: int, turn: int) -> float:
    """Return the median milliseconds per frame over the frames before a given one, at most one turn."""
    begin = max(frame - turn // 2, 0)
    return float(np.median(journey.milliseconds[begin : begin + turn]))


def memory(journey: Journey, early: int) -> Iterator[tuple[str, float, float, float]]:
    """Return the resident megabytes of each process: early, last and maximum."""
    for name, looks in journey.looks.items():
        megabytes = [look.megabytes for look in looks]
        first = next(look.megabytes for look in looks if look.frame >= early)
        yield name, first, megabytes[-1], max(megabytes)


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--frames", type=int, default=20_000, help="minimum number of frames (default: %(default)s)")
    parser.add_argument("--plot", type=Path, default=Path("out/endurance.png"), help="(default: %(default)s)")
    options = parser.parse_args()
    publish(figures(options), options)
