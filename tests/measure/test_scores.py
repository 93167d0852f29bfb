"""Measures of accuracy: equal to the benchmarks, and the laws of overlap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from catstream.base.box import Box
from catstream.measure.scores import overlaps, precision_plot, score, success_plot


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


def test_normalised_precision_is_that_of_trackingnet():
    """Mueller et al. 2018, frame by frame."""
    found, truth = boxes()
    shares = []
    for threshold in np.linspace(0, 0.5, 51):
        near = 0
        for (x, y, w, h), (u, v, s, t) in zip(found, truth, strict=True):
            apart = np.array([(x + w / 2 - u - s / 2) / s, (y + h / 2 - v - t / 2) / t])
            near += np.sqrt((apart**2).sum()) <= threshold
        shares.append(near / len(truth))
    assert score(found, truth).normalised_precision == pytest.approx(np.mean(shares))


def test_perfect_run_scores_one_and_an_empty_one_zero():
    truth = boxes()[1]
    truth[5:9] = np.nan
    best, worst = score(truth, truth), score(np.full_like(truth, np.nan), truth)
    assert (best.success, best.precision, best.normalised_precision) == (1, 1, 1)
    assert best.auc == pytest.approx(20 / 21)  # nothing is above an overlap of 1
    assert (worst.auc, worst.success, worst.precision, worst.normalised_precision) == (0, 0, 0, 0)


def test_frames_without_the_object_do_not_count(rng):
    found, truth = boxes()
    absent = np.zeros(len(truth), bool)
    absent[rng.permutation(len(truth))[:10]] = True
    kept = score(found[~absent], truth[~absent])
    truth[absent] = np.nan
    result = score(found, truth)
    assert (result.auc, result.success, result.precision) == (kept.auc, kept.success, kept.precision)


def test_frames_without_a_box_are_noticed_or_false_absence():
    found, truth = boxes()
    truth[10:18], found[15:25] = np.nan, np.nan
    result = score(found, truth)
    assert (result.absent, result.noticed, result.present, result.false) == (8, 3, 32, 7)


SIDES = st.tuples(*[st.floats(-50, 50)] * 2, *[st.floats(0.1, 50)] * 2)


@given(SIDES, SIDES)
def test_overlap_is_symmetric_and_equals_that_of_box(one, two):
    first, second = np.array([one]), np.array([two])
    value = overlaps(first, second)[0]
    assert value == pytest.approx(Box(*one).overlap(Box(*two)), abs=1e-9)
    assert value == pytest.approx(overlaps(second, first)[0])
    assert 0 <= value <= 1
