"""Processor time of a frame, without decoding, of catstream and of OpenCV's trackers in turns.

Other work on the machine changes it less than the time. CSRT and KCF need pip install "catstream[peers]", NanoTrack
its model files: see README.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from statistics import fmean, median
from time import process_time

from accuracy import available
from opencv_trackers import Peer
from sequences import named
from table import Table, benchmark, command

from catstream.base.settings import Settings
from catstream.measure.datasets import Sequence
from catstream.tracker import Tracker

TRACKERS = ("catstream", "csrt", "kcf", "mil", "nano", "nano-v3")


def figures(options: argparse.Namespace) -> Iterator[Table]:
    trackers, missing = available(TRACKERS, options.models if options.models.is_dir() else None)
    names = options.sequences[:1] if options.quick else options.sequences
    turns = [
        {tracker: cost(tracker, named(options, name), options) for tracker in trackers}
        for name in names
        for _ in range(options.turns)
    ]
    rows = [
        (tracker, fmean(turn[tracker] for turn in turns), median(turn[tracker] / turn["catstream"] for turn in turns))
        for tracker in trackers
    ]
    heads = ("tracker", "processor ms a frame", "times that of catstream")
    yield Table("Beside other trackers", heads, rows, f"{', '.join(names)}; {options.frames} frames{missing}")


def cost(name: str, sequence: Sequence, options: argparse.Namespace) -> float:
    """Return the processor time of a frame in milliseconds, of all but the first."""
    tracker = Tracker(Settings()) if name == "catstream" else Peer(name, options.models)
    frames, seconds = islice(sequence.frames(), options.frames), []
    tracker.init(next(frames), sequence.boxes[0])
    for frame in frames:
        begin = process_time()
        tracker.update(frame)
        seconds.append(process_time() - begin)
    return 1000 * fmean(seconds)


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        sequences=(["TLD_01_david", "OTB_Woman", "VOT2014_ball"], "names of sequences"),
        frames=(100, "first frames of each"),
        turns=(1, "turns on each sequence"),
        models=(Path("models"), "folder of the model files"),
    )
