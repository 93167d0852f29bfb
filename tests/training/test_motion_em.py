"""Expectation maximisation of the motion, against pykalman and its own laws."""

import numpy as np
import pykalman
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from catstream.training import motion_em
from catstream.training.motion_em import FEWEST, OBSERVATION_FLOOR, PROCESS_FLOOR, learn_motion


def walk(rng: np.random.Generator, frames: int = 64) -> np.ndarray:
    """Centres of an object that is pushed about, measured with an error of 1.5 pixels."""
    velocity = np.cumsum(rng.normal(scale=0.5, size=(frames, 2)), axis=0)
    return 100 + np.cumsum(velocity, axis=0) + rng.normal(scale=1.5, size=(frames, 2))


def oracle(centres: np.ndarray) -> pykalman.KalmanFilter:
    """The same model in pykalman, with the covariances that learning starts from."""
    mean, covariance, motion = motion_em._start(centres[np.isfinite(centres).all(axis=1)])
    return pykalman.KalmanFilter(
        transition_matrices=[[1, 0, 1, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]],
        observation_matrices=[[1, 0, 0, 0], [0, 1, 0, 0]],
        transition_covariance=motion.process,
        observation_covariance=motion.observation,
        initial_state_mean=mean,
        initial_state_covariance=covariance,
        em_vars=["transition_covariance", "observation_covariance"],
    )


@pytest.mark.parametrize("missing", [0, 20])
def test_motion_model_agrees_with_pykalman(rng, missing):
    centres = walk(rng)
    centres[rng.permutation(62)[:missing] + 1] = np.nan
    learned, expected = learn_motion(centres, 10), oracle(centres).em(np.ma.masked_invalid(centres), n_iter=10)
    assert_allclose(learned.process, expected.transition_covariance, rtol=1e-6, atol=1e-6)
    assert_allclose(learned.observation, expected.observation_covariance, rtol=1e-6, atol=1e-6)
    for covariance in (learned.process, learned.observation):
        assert_array_equal(covariance, covariance.T, "symmetric to the bit")


def test_frames_outside_the_first_and_last_centre_are_ignored(rng):
    centres = walk(rng)
    absent = np.full((5, 2), np.nan)
    inner, padded = learn_motion(centres), learn_motion(np.vstack([absent, centres, absent]))
    assert_array_equal(padded.process, inner.process)
    assert_array_equal(padded.observation, inner.observation)


@pytest.mark.parametrize(
    "centres", [np.full((64, 2), 80.0), np.outer(np.arange(64.0), [3, -2])], ids=["motionless", "steady"]
)
def test_perfect_motion_gives_small_positive_definite_covariances(centres):
    motion = learn_motion(centres)
    for covariance, floor in [(motion.process, PROCESS_FLOOR), (motion.observation, OBSERVATION_FLOOR)]:
        assert np.linalg.eigvalsh(covariance).min() >= floor * (1 - 1e-9)
        assert np.linalg.eigvalsh(covariance).max() < 0.5


@pytest.mark.parametrize(("frames", "count"), [(0, 0), (64, 0), (64, 1), (64, FEWEST - 1)])
def test_too_few_centres_give_no_motion(rng, frames, count):
    centres = np.full((frames, 2), np.nan)
    centres[3 : 3 + count] = rng.normal(size=(count, 2))
    assert learn_motion(centres) is None
