"""The measures: those of the benchmarks, number by number, and the laws they keep."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from catstream.base.box import Box
from catstream.evaluation.scores import (
    Absence,
    distances,
    is_lost,
    long_term,
    overlaps,
    precision_plot,
    score,
    success_plot,
)


def boxes(frames: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A run that drifts away, and its truth."""
    k = np.arange(frames)
    truth = [60 + 40 * np.sin(k / 7), 50 + 30 * np.cos(k / 5), 30 + 8 * np.sin(k / 11), 24 + 6 * np.cos(k / 13)]
    drift = [24 * np.sin(3 * k), 24 * np.cos(5 * k), 9 * np.sin(k), 9 * np.cos(2 * k)]
    rows = np.stack(truth, axis=1).round(2)
    return (rows + (k / frames)[:, None] * np.stack(drift, axis=1)).round(2), rows


#: What got10k 0.1.3 (PyPI) says of `boxes()`: ExperimentOTB._calc_metrics and ._calc_curves, run once.
GOT10K_SUCCESS = [
    *(0.875, 0.825, 0.8, 0.75, 0.725, 0.675, 0.65, 0.6, 0.525, 0.45, 0.375),
    *(0.35, 0.25, 0.2, 0.175, 0.175, 0.125, 0.125, 0.075, 0.05, 0.0),
]
GOT10K_PRECISION = [0.025, 0.05, 0.125, 0.15, 0.175]
GOT10K_OVERLAPS = [1.0, 0.98054191, 0.91392552, 0.88974691]


def test_success_and_precision_agree_with_got10k():
    found, truth = boxes()
    assert_allclose(overlaps(found, truth)[:4], GOT10K_OVERLAPS, rtol=1e-7)
    assert_allclose(success_plot(found, truth), GOT10K_SUCCESS)
    assert_allclose(precision_plot(found, truth)[:5], GOT10K_PRECISION)
    result = score(found, truth)
    assert result.auc == pytest.approx(0.41785714285714287)
    assert result.success == pytest.approx(0.375)
    assert result.precision == pytest.approx(0.775)


def test_normalised_precision_is_the_mean_share_over_distances_in_parts_of_the_size():
    """As defined with TrackingNet (Mueller et al. 2018), frame by frame."""
    found, truth = boxes()
    shares = []
    for threshold in np.linspace(0, 0.5, 51):
        near = 0
        for (x, y, w, h), (u, v, s, t) in zip(found, truth, strict=True):
            apart = np.array([(x + w / 2 - u - s / 2) / s, (y + h / 2 - v - t / 2) / t])
            near += np.sqrt((apart**2).sum()) <= threshold
        shares.append(near / len(truth))
    assert score(found, truth).normalised_precision == pytest.approx(np.mean(shares))


def test_the_long_term_measures_are_the_best_over_all_thresholds(rng):
    """As defined with VOT-LT (Lukezic et al. 2020), threshold by threshold."""
    found, truth = boxes()
    truth[10:18] = np.nan
    found[15:25] = np.nan
    confidence = rng.integers(0, 9, len(truth)) / 8
    best = (0.0, 0.0, 0.0)
    for threshold in np.unique(confidence):
        answered = (confidence >= threshold) & np.isfinite(found).all(axis=1)
        shared = overlaps(found, truth)[answered]
        if answered.any():
            precision, recall = shared.mean(), shared.sum() / np.isfinite(truth).all(axis=1).sum()
            best = max(best, (2 * precision * recall / (precision + recall), precision, recall))
    result = long_term(found, truth, confidence)
    assert (result.f_score, result.precision, result.recall) == pytest.approx(best)


def test_a_perfect_run_is_perfect_and_one_without_boxes_scores_zero():
    truth = boxes()[1]
    truth[5:9] = np.nan
    best, worst = score(truth, truth, np.ones(len(truth))), score(np.full_like(truth, np.nan), truth)
    assert (best.success, best.precision, best.normalised_precision) == (1, 1, 1)
    assert best.auc == pytest.approx(20 / 21)  # nothing is above an overlap of 1
    assert (worst.auc, worst.success, worst.precision, worst.normalised_precision) == (0, 0, 0, 0)
    assert [result.long_term and result.long_term.f_score for result in (best, worst)] == [1, 0]


def test_frames_without_the_object_do_not_count(rng):
    found, truth = boxes()
    absent = np.zeros(len(truth), bool)
    absent[rng.permutation(len(truth))[:10]] = True
    kept = score(found[~absent], truth[~absent])
    truth[absent] = np.nan
    result = score(found, truth)
    assert (result.auc, result.success, result.precision) == (kept.auc, kept.success, kept.precision)


def test_frames_without_a_reported_box_count_as_missed():
    found, truth = boxes()
    half = found.copy()
    half[::2] = np.nan
    assert overlaps(half, truth)[::2].max() == 0
    assert np.isinf(distances(half, truth)[::2]).all()
    assert score(half, truth).success <= score(found, truth).success


def test_frames_without_a_reported_box_are_noticed_or_false_absence():
    found, truth = boxes()
    truth[10:18], found[15:25] = np.nan, np.nan
    assert score(found, truth).absence == Absence(absent=8, noticed=3, present=32, false=7)


def test_boxes_in_frames_without_the_object_reduce_precision_by_their_confidence():
    truth = boxes()[1]
    found = truth.copy()
    truth[10:20] = np.nan
    sure, unsure = np.ones(len(truth)), np.where(np.isnan(truth[:, 0]), 0.1, 0.9)
    assert long_term(found, truth, sure).precision == pytest.approx(0.75)
    assert long_term(found, truth, sure).recall == 1
    assert long_term(found, truth, unsure).f_score == 1


@pytest.mark.parametrize(
    ("followed", "lost"),
    [
        ([True] * 8, False),
        ([False] * 6 + [True, True], False),
        ([True] * 6 + [True, False], False),  # half of the last quarter
        ([True] * 6 + [False, False], True),
        ([True] * 3 + [False] * 2, True),  # the last quarter of five frames is two
        ([True] * 5 + [False, True, True, True], False),
        ([True] * 12 + [True, None, None, None], False),  # frames without the object count for no loss
        ([True] * 12 + [False, None, None, None], True),
        ([True] * 12 + [None, None, None, None], False),
    ],
)
def test_a_run_is_lost_if_less_than_half_of_its_last_quarter_is_followed(followed, lost):
    truth = np.tile([10.0, 10, 20, 20], (len(followed), 1))
    boxes = np.where(np.array(followed, bool)[:, None], truth, truth + 15)
    truth[[each is None for each in followed]] = np.nan
    assert is_lost(boxes, truth) == score(boxes, truth).lost == lost


SIDES = st.tuples(*[st.floats(-50, 50)] * 2, *[st.floats(0.1, 50)] * 2)


@given(SIDES, SIDES)
def test_overlap_is_symmetric_and_equals_that_of_box(one, two):
    first, second = np.array([one]), np.array([two])
    value = overlaps(first, second)[0]
    assert value == pytest.approx(Box(*one).overlap(Box(*two)), abs=1e-9)
    assert value == pytest.approx(overlaps(second, first)[0])
    assert 0 <= value <= 1
