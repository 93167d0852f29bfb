"""Compares the accuracy of several settings or trackers over the same sequences and starts."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from sequences import CHECK, sequences
from table import command

from catstream.base.settings import Settings
from catstream.errors import SettingsError
from catstream.evaluation.accuracy import rows_of
from catstream.evaluation.datasets import Sequence, Starts, choose_starts
from catstream.evaluation.onepass import evaluate
from catstream.evaluation.peers import PEERS, Peer
from catstream.evaluation.runs import EvaluationRun

#: Headings for the values of `means`.
MEANS = ("AUC", "success", "precision")


def accuracy_command(about: str | None, starts: int = 1, *, kept: bool = True) -> argparse.ArgumentParser:
    """Return a parser with the options of a benchmark over many sequences and starts."""
    parser = command(about)
    parser.add_argument("--group", choices=("all", "tuning", "check"), default="all", help="only these sequences")
    parser.add_argument("--frames", type=int, help="number of frames of each sequence (default: all)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of processes (default: %(default)s)")
    if kept:
        parser.add_argument("--output", type=Path, help="folder for the runs; complete runs are not repeated")
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument(
        "--starts", type=int, default=starts, help="number of start frames of each sequence (default: %(default)s)"
    )
    chosen.add_argument("--jitter", type=int, metavar="K", help="K first boxes within 2 %% instead")
    return parser


def videos(options: argparse.Namespace, prefix: str = "") -> list[Sequence]:
    """Return the sequences of `--group` whose names begin with `prefix`, cut to the first `--frames`."""
    found = shortened(options, prefix)
    if options.quick or options.group == "all":
        return found
    return [one for one in found if (one.name in CHECK) == (options.group == "check")]


def shortened(options: argparse.Namespace, prefix: str = "") -> list[Sequence]:
    """Return the sequences whose names begin with `prefix`, cut to the first `--frames`."""
    return [replace(found, boxes=found.boxes[: options.frames]) for found in sequences(options, prefix)]


def available(names: Iterable[str], models: Path | None = None) -> tuple[list[str], str]:
    """Return the trackers that this OpenCV has, and a line for each one that is missing."""
    trackers, missing = [], ""
    for name in names:
        try:
            if name in PEERS:
                Peer(name, models)
            trackers.append(name)
        except SettingsError as error:  # the message has the install command, or the names of the model files
            missing += f"\n{error}"
    return trackers, missing


def starts_of(options: argparse.Namespace) -> Starts:
    """Return the starts of each sequence that the options choose; with --quick, the first frame."""
    if options.quick:
        return choose_starts()
    return choose_starts(None if options.jitter else options.starts, options.jitter)


def described(options: argparse.Namespace) -> str:
    """Return the starts of each sequence in words."""
    return f"{options.jitter} first boxes" if options.jitter else f"{options.starts} starts"


def compared(
    options: argparse.Namespace, sequences: list[Sequence], variants: dict[str, Settings]
) -> dict[str, list[EvaluationRun]]:
    """Run catstream with each of several settings; return the runs by name, in the same order for each."""
    return {
        name: evaluate(
            sequences,
            ["catstream"],
            settings,
            starts=starts_of(options),
            jobs=1 if options.quick else options.jobs,
            output=options.output and options.output / name.replace("/", "-"),
            done=lambda run, name=name: print(f"{name}: {run.name}", file=sys.stderr),
        )
        for name, settings in variants.items()
    }


def means(runs: Iterable[EvaluationRun]) -> tuple[float, float, float]:
    """Return the means of AUC, success and precision over the runs of each sequence, then over the sequences."""
    rows = rows_of(runs)
    return tuple(fmean(getattr(row, measure.lower()) for row in rows) for measure in MEANS)


def spread(runs: Iterable[EvaluationRun]) -> float:
    """Return the standard deviation of the AUC over the runs of a sequence, averaged over the sequences."""
    return fmean(row.auc_spread for row in rows_of(runs))
