"""Ablation: accuracy without each ingredient of the tracker, over several starts or first boxes of each sequence.

Single runs are chaotic: what counts is the difference sequence by sequence, beside its standard error. How many runs
changed shows how much the sequences depend on an ingredient.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from accuracy import MEANS, accuracy_command, changed, compared, described, difference, means, spread, videos
from table import Table, benchmark

from catstream.base.settings import Settings
from catstream.evaluation.runs import EvaluationRun

COLUMNS = ("variant", *MEANS, "spread of AUC", "AUC lost", "± standard error", "runs changed")
_NEVER = -100.0  # lower than any score
_LONGER_THAN_ANY_VIDEO = 1 << 30

#: Ingredient -> the settings that switch it off.
WITHOUT: dict[str, dict[str, Any]] = {
    "loss tree": {"teaching.classifier": "least-squares"},
    "least squares, a one-class SVM instead": {"teaching.classifier": "one-class"},
    "hard negatives of the whole frame": {"teaching.hard_negatives": 0},
    "near misses": {"teaching.near_misses": 0},
    "distrust of a redetected object": {"belief.trusted_score": _NEVER},
    "search of the whole frame": {"belief.jump_margin": -_NEVER},
    "affine copies of each frame": {"teaching.copies": 0},
    "mirrored copies": {"teaching.mirrored": 0},
    "other backgrounds behind the first copies": {"teaching.other_backgrounds": 0.0},
    "histogram of colours": {"teaching.colours": False},
    "search over scales": {"extent.size_count": 1},
    "extent tree": {"extent.weight": 0.0},
    "another aspect than the first": {"extent.aspect_count": 1},
    "prior of the first extent": {"extent.prior": 0.0},
    "Kalman filter": {"search.motion_frames": _LONGER_THAN_ANY_VIDEO},
    "window wider than the object": {"search.context": 1.0},
    "report of absence": {"belief.weak_score": _NEVER},
    "training on confident detections only": {"belief.confident_score": Settings().belief.weak_score},
}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    base = Settings()
    variants = {"nothing left out": base}
    variants |= {f"without {name}": base.replace(changes) for name, changes in WITHOUT.items()}
    if options.only:
        variants = {
            name: settings
            for name, settings in variants.items()
            if settings is base or any(word in name for word in options.only)
        }
    if options.quick:
        variants = dict(list(variants.items())[:2])
    found = videos(options)
    runs = compared(options, found, variants)
    whole = runs["nothing left out"]
    note = f"{len(whole)} runs each; spread: standard deviation over {described(options)}, mean over the sequences"
    yield Table("Ablation", COLUMNS, beside(whole, runs), note)


def beside(whole: list[EvaluationRun], runs: dict[str, list[EvaluationRun]]) -> list[tuple[str | float, ...]]:
    """Return a row for each variant: means, loss against the complete tracker, and number of different runs."""
    return [
        (name, *means(found), spread(found), *difference(whole, found), changed(whole, found))
        for name, found in runs.items()
    ]


if __name__ == "__main__":
    parser = accuracy_command(__doc__, starts=5)
    parser.add_argument(
        "--only", nargs="+", metavar="WORD", help="only ingredients with one of these words in the name"
    )
    benchmark(figures, parser)
