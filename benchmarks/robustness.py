"""Accuracy of catstream and OpenCV's trackers, from one start or several, by sequence and by attribute.

By default, a tracker starts once, in the first frame with the object. Chance decides on a difficult sequence whether it
is lost: with --jitter or --shifts, the sequences are named whose smallest and largest success differ by more than 0.25.
CSRT, KCF and TLD need pip install "catstream[peers]", NanoTrack and VitTrack their model files: see README.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

from accuracy import FLIP, Row, accuracy_command, available, rows_of, run_all, videos
from starts import jittered, one_pass, spatial, temporal
from table import Cell, Table, benchmark

from catstream.base.settings import Settings

_MEASURES = ("auc", "success", "precision", "normalised_precision", "lost", "fps")
_COUNTS = ("absent", "noticed", "present", "false")
_SPREADS = ("auc_spread", "success_spread")


def figures(options: argparse.Namespace) -> Iterator[Table]:
    trackers, missing = available(options.trackers, options.models if options.models.is_dir() else None)
    starts = one_pass
    if not options.quick:
        if options.shifts:
            starts = spatial
        elif options.jitter:
            starts = jittered(options.jitter)
        elif options.starts:
            starts = temporal(options.starts)
    runs = run_all(
        videos(options), trackers, Settings(), starts, options.models, jobs=1 if options.quick else options.jobs
    )
    rows = rows_of(runs)
    flips = {tracker: [row.name for row in rows if row.tracker == tracker and row.flips] for tracker in trackers}
    attributes = json.loads(Path(__file__).with_name("attributes.json").read_text(encoding="utf-8"))
    groups: dict[str, list[Row]] = {}
    for row in rows:
        for attribute in attributes.get(row.name, ()):
            groups.setdefault(attribute, []).append(row)
    options.record = {
        "sequences": [asdict(row) for row in rows],
        "mean": means(rows),
        "flips": flips if any(row.flips is not None for row in rows) else {},
        "attributes": {attribute: means(group) for attribute, group in sorted(groups.items())},
    }

    heads = ("sequence", "tracker", *_MEASURES, *_SPREADS, *_COUNTS)
    note = missing
    if options.record["flips"]:
        note += "".join(
            f"\n{tracker}: {len(names)} sequences flip (success differs by more than {FLIP}): {', '.join(names)}"
            for tracker, names in flips.items()
        )
    yield Table("Sequences", heads, [(row.name, row.tracker, *cells(asdict(row))) for row in rows], note.strip())
    total = [("mean", tracker, *cells(mean)) for tracker, mean in means(rows).items()]
    by_attribute = [
        (attribute, tracker, *cells(mean))
        for attribute, group in sorted(groups.items())
        for tracker, mean in means(group).items()
    ]
    yield Table("Means", ("sequences", *heads[1:]), total + by_attribute)


def means(rows: list[Row]) -> dict[str, dict[str, Any]]:
    """Return the means of the measures over the sequences, and the sums of the numbers of frames, by tracker."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.tracker, []).append(row)
    return {
        tracker: {name: fmean(getattr(row, name) for row in group) for name in (*_MEASURES, *_SPREADS)}
        | {name: sum(getattr(row, name) for row in group) for name in _COUNTS}
        for tracker, group in groups.items()
    }


def cells(measured: dict[str, Any]) -> list[Cell]:
    return [measured[name] for name in (*_MEASURES, *_SPREADS, *_COUNTS)]


if __name__ == "__main__":
    parser = accuracy_command(__doc__, starts=0)
    parser.add_argument("--shifts", action="store_true", help="12 shifted or scaled first boxes instead (SRE)")
    benchmark(
        figures,
        parser,
        trackers=(["catstream"], "catstream, mil, csrt, kcf, tld, nano, nano-v3 or vit"),
        models=(Path("models"), "folder of the model files"),
    )
