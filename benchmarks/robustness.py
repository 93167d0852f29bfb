"""Accuracy over many starts and first boxes, for the tuning and the check sequences apart, beside other trackers.

    ope     one-pass evaluation: one run of each sequence
    tre     temporal robustness: runs from several frames
    sre     spatial robustness: 12 first boxes, shifted or scaled
    jitter  several first boxes that differ by at most 2 %

A run is lost if fewer than half of the frames in its last quarter have an overlap above 0.5: such losses are counted
over the runs of `tre` and `jitter`. The standard error is over the sequences; runs over one sequence are alike, and
count as one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from accuracy import available, many_sequences, videos
from sequences import CHECK
from table import Cell, Table, benchmark, command, mean_and_error

from catstream.base.settings import Settings
from catstream.evaluation.accuracy import Row, rows_of
from catstream.evaluation.datasets import (
    Sequence,
    Start,
    Starts,
    jittered,
    one_pass,
    read_attributes,
    spatial,
    temporal,
)
from catstream.evaluation.onepass import TRACKERS, evaluate
from catstream.evaluation.runs import EvaluationRun

PARTS = ("ope", "tre", "sre", "jitter")
ATTRIBUTES = Path(__file__).with_name("attributes.json")
COLUMNS = ("tracker", "starts", "group", "sequences", "AUC", "AUC ±", "success", "success ±", "F", "F ±", "flip")
LOSSES = ("tracker", "group", "sequences", "runs", "lost", "mean", "±")

#: The rows of each tracker and part.
Found = Mapping[tuple[str, str], list[Row]]


def figures(options: argparse.Namespace) -> Iterator[Table]:
    sequences, seen = videos(options), read_attributes(options.attributes)
    trackers, missing = available(options.trackers, options.peer_models)
    if missing:
        print(missing.strip(), file=sys.stderr)
    parts = {tracker: options.parts if tracker == "catstream" else options.peer_parts for tracker in trackers}
    chosen = starts_by_part(options)
    found: dict[tuple[str, str], list[Row]] = {}
    for tracker, own in parts.items():
        runs = followed(options, tracker, sequences, [chosen[part] for part in own])
        for part in own:
            starts = {sequence.name: set(chosen[part](sequence)) for sequence in sequences}
            found[tracker, part] = rows_of(run for run in runs if run.start in starts[run.sequence.name])
    groups = groups_of(sequences)
    yield overview(found, described(options), groups)
    attributes = {"any": [sequence.name for sequence in sequences]}
    attributes |= with_attributes(attributes["any"], seen)
    yield by_attribute(found, attributes)
    if lost := list(losses(found, groups)):
        yield Table("Losses", LOSSES, lost, "mean: of the share of the runs of a sequence; ±: its standard error")


def starts_by_part(options: argparse.Namespace) -> dict[str, Starts]:
    """Return the starts of each part."""
    chosen: list[Starts] = [one_pass, temporal(options.starts), spatial, jittered(options.jitter)]
    return dict(zip(PARTS, map(first_two, chosen) if options.quick else chosen, strict=True))


def first_two(starts: Starts) -> Starts:
    """Return only the first two of the starts of each sequence."""
    return lambda sequence: starts(sequence)[:2]


def described(options: argparse.Namespace) -> dict[str, str]:
    """Return each part in words."""
    words = ("OPE", f"TRE, {options.starts} frames", "SRE, 12 boxes", f"jitter, {options.jitter} boxes")
    return dict(zip(PARTS, words, strict=True))


def followed(
    options: argparse.Namespace, tracker: str, sequences: list[Sequence], parts: list[Starts]
) -> list[EvaluationRun]:
    """Run a tracker on all sequences from the starts of several parts; a start that is in two parts runs once."""

    def starts(sequence: Sequence) -> list[Start]:
        return list(dict.fromkeys(start for part in parts for start in part(sequence)))

    return evaluate(
        sequences,
        [tracker],
        Settings(),
        starts=starts,
        peer_models=options.peer_models,
        jobs=1 if options.quick else options.jobs,
        output=options.output,
        done=lambda run: print(f"{tracker}: {run.name}", file=sys.stderr),
    )


def groups_of(sequences: Iterable[Sequence]) -> dict[str, set[str]]:
    """Return the names of the sequences of each group; only groups with sequences."""
    names = {sequence.name for sequence in sequences}
    groups = {"all": names, "tuning": names - CHECK, "check": names & CHECK}
    return {group: members for group, members in groups.items() if members}


def overview(found: Found, parts: Mapping[str, str], groups: Mapping[str, set[str]]) -> Table:
    """Return the mean of each tracker and part over each group of sequences, with its standard error."""
    rows: list[list[Cell]] = []
    note = "±: standard error over the sequences; F: of the sequences in which the object is absent in some frames"
    for (tracker, part), measured in found.items():
        for group, names in groups.items():
            members = [row for row in measured if row.name in names]
            rows.append([tracker, parts[part], group, len(members), *summarised(members), flips(members, part)])
        if names := [row.name for row in measured if part == "jitter" and row.flips]:
            note += f"\n{tracker} flips on {', '.join(names)}"
    return Table("Robustness", COLUMNS, rows, note)


def summarised(rows: list[Row]) -> Iterator[float | None]:
    """Return the mean and the standard error of AUC, success and F-score."""
    for measure in ("auc", "success", "f_score"):
        yield from mean_and_error([getattr(row, measure) for row in rows])


def losses(found: Found, groups: Mapping[str, set[str]]) -> Iterator[list[Cell]]:
    """Yield the lost runs of each tracker and group, over the runs from several frames and from several first boxes."""
    for tracker in dict.fromkeys(tracker for tracker, _ in found):
        measured = [row for part in ("tre", "jitter") for row in found.get((tracker, part), [])]
        for group, names in groups.items():
            runs = {name: [row.runs for row in measured if row.name == name] for name in sorted(names)}
            lost = {name: [row.lost * row.runs for row in measured if row.name == name] for name in runs}
            if total := sum(map(sum, runs.values())):
                shares = [sum(lost[name]) / sum(runs[name]) for name in runs]
                yield [tracker, group, len(runs), total, round(sum(map(sum, lost.values()))), *mean_and_error(shares)]


def flips(rows: list[Row], part: str) -> int | None:
    """Return the number of sequences that flip with the jitter of the first box; None for the other parts."""
    return sum(bool(row.flips) for row in rows) if part == "jitter" else None


def with_attributes(names: Iterable[str], attributes: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Return which of these sequences have each attribute; `attributes` is what `read_attributes` returns.

    >>> with_attributes(["walk", "run"], {"walk": ["blur"], "run": ["blur", "occlusion"], "other": ["blur"]})
    {'blur': ['walk', 'run'], 'occlusion': ['run']}
    """
    found: dict[str, list[str]] = {}
    for name in names:
        for attribute in dict.fromkeys(attributes.get(name, ())):
            found.setdefault(attribute, []).append(name)
    return dict(sorted(found.items()))


def by_attribute(found: Found, attributes: Mapping[str, list[str]]) -> Table:
    """Return the means of the trackers over the sequences with each attribute, from the first part of each tracker."""
    first: dict[str, list[Row]] = {}
    for (tracker, _), measured in found.items():
        first.setdefault(tracker, measured)
    rows: list[list[Cell]] = []
    for attribute, names in attributes.items():
        cells: list[Cell] = [attribute, len(names), len(CHECK & set(names))]
        for measured in first.values():
            members = [row for row in measured if row.name in names]
            cells += [*mean_and_error(row.auc for row in members), mean_and_error(row.success for row in members)[0]]
        rows.append(cells)
    columns = [f"{tracker}{word}" for tracker in first for word in (" AUC", " ±", " success")]
    return Table(
        "Attributes", ("attribute", "sequences", "check", *columns), rows, "check: number of check sequences among them"
    )


if __name__ == "__main__":
    parser = many_sequences(command(__doc__))
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="parts for catstream (default: all)")
    parser.add_argument("--peer-parts", nargs="+", choices=PARTS, default=PARTS[:1], help="for others (default: ope)")
    parser.add_argument("--trackers", nargs="+", choices=TRACKERS, default=TRACKERS, help="those that are installed")
    parser.add_argument("--peer-models", type=Path, metavar="FOLDER", help="model files of nano and vit")
    benchmark(
        figures,
        parser,
        starts=(5, "number of frames of tre"),
        jitter=(7, "number of boxes of jitter"),
        attributes=(ATTRIBUTES, "attributes of the sequences"),
    )
