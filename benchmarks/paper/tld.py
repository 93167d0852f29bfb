"""Table 2 of the paper: success on the TLD videos, with n = 10 % and 25 % of the video and with our settings.

The paper follows ten videos, we those of them that are there. Its tables 2 and 5 have the columns of Panda and
Volkswagen the other way round; this is as table 2 prints it. A second table has the success in the frames that SCM
follows, until n rows make the first leaf, and in those after them.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from statistics import fmean

import shared  # noqa: F401
from accuracy import TrackerRun, accuracy_command, compared, rows_of, videos
from table import Table, benchmark

from catstream.base.settings import PRESETS, Settings
from catstream.measure.scores import score

#: Our settings, and presets.
TRACKERS = ("defaults", "cat25", "cat10")

#: Tracker -> success in the paper: mean of ten videos, and Panda.
PAPER = {
    "cat25": (0.66, 0.58),
    "TLD": (0.57, 0.25),
    "cat10": (0.56, 0.49),
    "Struck": (0.40, 0.21),
    "TGPR": (0.38, 0.12),
    "SCM": (0.36, 0.13),
}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    variants = {name: Settings.from_values(PRESETS.get(name, {})) for name in options.trackers}
    found = videos(options, "TLD_")
    rows = []
    parts: list[tuple[str | float, ...]] = []
    for name, runs in compared(options, found, variants).items():
        success = [row.success for row in rows_of(runs)]
        rows.append((name, fmean(success), *success, *PAPER.get(name, (None, None))))
        if variants[name].training.bootstrap == "scm":
            parts += by_part(name, [run for run in runs if run.start.frame == 0], variants[name])
    nothing = (None,) * (1 + len(found))
    rows += [(name, *nothing, *printed) for name, printed in PAPER.items() if name not in variants]
    names = [video.name.removeprefix("TLD_") for video in found]
    yield Table("Success on TLD", ("tracker", "mean", *names, "paper: mean of ten", "paper: Panda"), rows)
    if parts:
        yield Table("Success by part of the video", ("tracker", "followed by", "mean", *names), parts)


def by_part(tracker: str, runs: list[TrackerRun], settings: Settings) -> Iterator[tuple[str | float, ...]]:
    """Rows of the success in the frames that SCM follows, until n rows make the first leaf, and in those after them."""

    def success(run: TrackerRun, *, scm: bool) -> float:
        of_video = settings.for_length(len(run.boxes))
        first = math.ceil(of_video.coreset.size / (1 + of_video.training.copies))
        part = slice(first) if scm else slice(first, None)
        return score(run.boxes[part], run.sequence.boxes[part]).success

    for name, scm in (("SCM", True), ("after SCM", False)):
        each = [success(run, scm=scm) for run in runs]
        yield tracker, name, fmean(each), *each


if __name__ == "__main__":
    parser = accuracy_command(__doc__)
    parser.add_argument("--trackers", nargs="+", choices=TRACKERS, default=TRACKERS, help="default: all")
    benchmark(figures, parser)
