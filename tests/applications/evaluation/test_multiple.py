"""MOTA, IDF1 and HOTA of several objects."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from catstream.applications.evaluation.multiple import score_multiple
from catstream.box import Box

NAMES = "abcde"


def noisy_case(seed):
    """Five objects in 60 frames: boxes are noisy, some are missing, and two exchange their names in frame 30."""
    rng = np.random.default_rng(seed)
    truth, found = [], []
    places, names = rng.uniform(0, 200, (5, 2)), dict(zip(NAMES, NAMES, strict=True))
    for frame in range(60):
        places = places + rng.normal(size=(5, 2)) * 2
        truth.append(
            {name: None if rng.random() < 0.1 else Box(*at, 30, 40) for name, at in zip(NAMES, places, strict=True)}
        )
        if frame == 30:
            names |= {"a": "b", "b": "a"}
        boxes = {}
        for name, at in zip(NAMES, places, strict=True):
            absent = rng.random() < 0.15
            boxes[names[name]] = (
                None if absent else Box(*(at + rng.normal(size=2) * 5), 30 * np.exp(rng.normal() * 0.1), 40)
            )
        found.append(boxes)
    return truth, found


@pytest.mark.parametrize(
    ("seed", "expected"), [(0, 0.3964280489299904), (1, 0.37030759851651895), (2, 0.3984270674302707)]
)
def test_hota_is_that_of_trackeval(seed, expected):
    assert score_multiple(*noisy_case(seed)).hota == pytest.approx(expected, rel=1e-9)  # by TrackEval 1.3.0


def by_motmetrics(truth, found):
    """MOTA, IDF1 and the identity switches by py-motmetrics."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pandas and motmetrics, about their own code
        import motmetrics

        accumulator = motmetrics.MOTAccumulator(auto_id=True)
        for true, boxes in zip(truth, found, strict=True):
            true, boxes = ({ord(name): box for name, box in each.items() if box} for each in (true, boxes))
            overlaps = np.array([[box.overlap(other) for other in boxes.values()] for box in true.values()])
            distances = np.where(overlaps >= 0.5, 1 - overlaps, np.nan).reshape(len(true), len(boxes))
            accumulator.update(list(true), list(boxes), distances)
        names = ["mota", "idf1", "num_switches"]
        return motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0].tolist()


@pytest.mark.parametrize("seed", range(20))
def test_mota_idf1_and_switches_are_those_of_motmetrics(seed):
    case = noisy_case(seed)
    scores = score_multiple(*case)
    assert [scores.mota, scores.idf1, scores.switches] == pytest.approx(by_motmetrics(*case))


def test_an_exchange_of_two_names_is_counted_as_two_switches():
    scores = score_multiple(*noisy_case(0))
    assert scores.switches == 2
    assert scores.idf1 == pytest.approx(0.5660, abs=1e-4)


def test_the_truth_itself_has_the_best_scores():
    truth, _ = noisy_case(0)
    scores = score_multiple(truth, truth)
    assert (scores.mota, scores.idf1, scores.hota, scores.switches) == (1, 1, pytest.approx(1), 0)


def test_nothing_found_scores_nothing():
    truth, _ = noisy_case(0)
    scores = score_multiple(truth, [{} for _ in truth])
    assert (scores.mota, scores.hota) == (0, 0)
