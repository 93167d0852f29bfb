"""The tables of the record of accuracy: means, worst and best, absence, and each sequence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain, zip_longest
from statistics import fmean
from typing import Any

from sequences import CHECK, TUNED
from table import Cell, Table

from catstream.evaluation.accuracy import COUNTS

Record = Mapping[str, Any]


def _members(record: Record) -> dict[str, list[str]]:
    """Return the names of the sequences of each group."""
    names = list(dict.fromkeys(row["name"] for row in record["sequences"]))
    return {
        "the first 20: tuned on": [name for name in names if name in TUNED],
        "the other 24": [name for name in names if name not in TUNED],
        "the check list, *": [name for name in names if name in CHECK],
        "of it, never tuned on": [name for name in names if name in CHECK - TUNED],
        "all": names,
    }


def groups(record: Record) -> Iterator[Table]:
    """Return the mean accuracy over each group of sequences: tuning set, others, and all."""
    trackers = list(record["mean"])
    rows = {(row["name"], row["tracker"]): row for row in record["sequences"]}
    heads = ["AUC, success of", "sequences", *(word for tracker in trackers for word in (tracker, ""))]
    means = []
    for group, members in _members(record).items():
        cells: list[Cell] = [group, len(members)]
        for tracker in trackers:
            cells += [fmean(rows[name, tracker][measure] for name in members) for measure in ("auc", "success")]
        means.append(cells)
    yield Table("", heads, means)


def extremes(record: Record) -> Iterator[Table]:
    """Return the sequences of each group on which the AUC of catstream is worst and best."""
    rows = {row["name"]: row for row in record["sequences"] if row["tracker"] == "catstream"}
    found: list[tuple[Cell, ...]] = []
    for group, members in _members(record).items():
        ranked = sorted((rows[name] for name in members), key=lambda row: float(row["auc"]))
        ends = ((row["name"], row["auc"], row["success"]) for row in (ranked[0], ranked[-1]))
        found.append((group, *chain(*ends)))
    yield Table("", ("AUC, success of catstream", "worst", "", "", "best", "", ""), found)


def absence(record: Record) -> Iterator[Table]:
    """Return how often catstream noticed absence in the sequences that have some, and in all."""
    rows = [row for row in record["sequences"] if row["tracker"] == "catstream"]
    total = {"name": f"all {len(rows)}", **{count: sum(row[count] for row in rows) for count in COUNTS}}
    found: list[tuple[Cell, ...]] = []
    for row in (*(row for row in rows if row["absent"]), total):
        absent, noticed, present, false = (row[count] for count in COUNTS)
        found.append((row["name"], absent, noticed, noticed / absent, present, false, false / present))
    heads = ("frames of", "without the object", "noticed", "share", "with the object", "falsely absent", "share")
    yield Table("", heads, found)


def by_sequence(record: Record) -> Iterator[Table]:
    """Return the accuracy on each sequence, of the tuning set beside the others."""
    rows = {(row["name"], row["tracker"]): row for row in record["sequences"]}
    names = list(dict.fromkeys(name for name, _ in rows))

    def column(members: list[str]) -> list[list[Cell]]:
        return [
            [
                f"{name} *" if name in CHECK else name,
                rows[name, "catstream"]["frames"],
                *(rows[name, "catstream"][measure] for measure in ("auc", "success")),
                rows[name, "csrt"]["auc"],
            ]
            for name in members
        ]

    left = column([name for name in names if name in TUNED])
    right = column([name for name in names if name not in TUNED])
    beside = [[*(a or [""] * 5), *(b or [""] * 5)] for a, b in zip_longest(left, right)]
    heads = ["the first 20", "frames", "AUC", "success", "CSRT", "the other 24", "frames", "AUC", "success", "CSRT"]
    yield Table("", heads, beside)
