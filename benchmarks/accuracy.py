"""Compares the accuracy of several settings or trackers over the same sequences and starts."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
from sequences import sequences
from table import command

from catstream.evaluation.datasets import Sequence
from catstream.evaluation.onepass import evaluate
from catstream.evaluation.runs import EvaluationRun
from catstream.evaluation.summary import rows_of
from catstream.settings import Settings

__all__ = ["accuracy_command", "changed", "compared", "difference", "means", "videos"]

#: Headings for the values of `means`.
MEANS = ("AUC", "success", "precision")


def accuracy_command(about: str | None, starts: int = 1, *, kept: bool = True) -> argparse.ArgumentParser:
    """Return a parser with the options of a benchmark over many sequences."""
    parser = command(about)
    parser.add_argument(
        "--starts", type=int, default=starts, help="number of start frames of each sequence (default: %(default)s)"
    )
    parser.add_argument("--frames", type=int, help="number of frames of each sequence (default: all)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of processes (default: %(default)s)")
    if kept:
        parser.add_argument("--output", type=Path, help="folder for the runs; complete runs are not repeated")
    return parser


def videos(options: argparse.Namespace, prefix: str = "") -> list[Sequence]:
    """Return the sequences whose names begin with `prefix`, cut to the first `--frames`."""
    return [replace(found, boxes=found.boxes[: options.frames]) for found in sequences(options, prefix)]


def compared(
    options: argparse.Namespace, sequences: list[Sequence], variants: dict[str, Settings]
) -> dict[str, list[EvaluationRun]]:
    """Run catstream with each of several settings; return the runs by name, in the same order for each."""
    return {
        name: evaluate(
            sequences,
            ["catstream"],
            settings,
            starts=1 if options.quick else options.starts,
            jobs=1 if options.quick else options.jobs,
            output=options.output and options.output / name.replace("/", "-"),
            done=lambda run, name=name: print(f"{name}: {run.name}", file=sys.stderr),
        )
        for name, settings in variants.items()
    }


def means(runs: Iterable[EvaluationRun]) -> tuple[float, float, float]:
    """Return the means of AUC, success and precision over the starts of each sequence, then over the sequences."""
    rows = rows_of(runs)
    return tuple(fmean(getattr(row, measure.lower()) for row in rows) for measure in MEANS)


def spread(runs: Iterable[EvaluationRun]) -> float:
    """Return the standard deviation of the AUC over the starts of a sequence, averaged over the sequences."""
    return fmean(row.auc_spread for row in rows_of(runs))


def difference(runs: list[EvaluationRun], others: list[EvaluationRun]) -> tuple[float, float]:
    """Return the mean difference of AUC over the sequences, and its standard error.

    Starts of one sequence are alike: they count as one.
    """
    pairs = zip(rows_of(runs), rows_of(others), strict=True)
    apart = np.array([row.auc - other.auc for row, other in pairs])
    return float(apart.mean()), float(apart.std(ddof=1) / np.sqrt(len(apart))) if len(apart) > 1 else 0.0


def changed(runs: list[EvaluationRun], others: list[EvaluationRun]) -> int:
    """Return the number of runs with any different box."""
    pairs = zip(runs, others, strict=True)
    return sum(not np.array_equal(run.boxes, other.boxes, equal_nan=True) for run, other in pairs)
