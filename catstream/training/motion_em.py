"""Expectation maximisation of the parameters of the Kalman filter (paper, "Classification").

The model is linear and Gaussian: the centre of the object moves at constant velocity with process noise, and is
measured with observation noise. EM estimates the covariances of both from the measured centres.
"""

from __future__ import annotations

import numpy as np

from catstream.arrays import Bool, Float64
from catstream.features.compiled import kernel
from catstream.kalman import OBSERVED, TRANSITION
from catstream.messages import Motion

__all__ = ["FEWEST", "OBSERVATION_FLOOR", "PROCESS_FLOOR", "learn_motion"]

FEWEST = 8  #: centres that 13 free parameters can be estimated from
PROCESS_FLOOR = 1e-4  #: smallest variance of the process, pixels squared: 0.01 pixels a frame
OBSERVATION_FLOOR = 1e-2  #: smallest variance of a measured centre, pixels squared: 0.1 pixels


def learn_motion(centres: np.ndarray, iterations: int = 10) -> Motion | None:
    """Estimate the covariances of the constant-velocity model from centres, by maximum likelihood.

    No iteration lowers the likelihood. The covariances are symmetric, and their eigenvalues are at least
    `PROCESS_FLOOR` and `OBSERVATION_FLOOR`, so that the filter also works for a motionless object. Costs O(m) an
    iteration, about 4 microseconds a frame.

    Parameters
    ----------
    centres : float64 (m, 2), x and y in pixels of consecutive frames, NaN while the object is absent
    iterations : number of expectation (smoothing) and maximisation (refitting) steps

    Returns
    -------
    Motion, or None for fewer than `FEWEST` centres

    >>> walk = np.column_stack([np.arange(20.0) * 3, np.full(20, 7.0)])
    >>> learn_motion(walk).observation.round(2)  # measured without error: the floor
    array([[0.01, 0.  ],
           [0.  , 0.01]])
    >>> learn_motion(walk[:5]) is None
    True
    """
    present = np.flatnonzero(np.isfinite(centres).all(axis=1))
    if len(present) < FEWEST:
        return None
    mean, covariance, motion = _start(centres[present])
    # Frames before the first centre and after the last carry no information.
    centres = np.array(centres[present[0] : present[-1] + 1], np.float64)  # a kernel takes no read-only array
    seen = np.isfinite(centres).all(axis=1)
    m = len(centres)
    states, covariances, lagged = np.empty((m, 4, 1)), np.empty((m, 4, 4)), np.empty((m - 1, 4, 4))
    for _ in range(iterations):
        states[0, :, 0] = mean
        _smooth(centres, seen, covariance, motion.process, motion.observation, TRANSITION, states, covariances, lagged)
        motion = _refit(centres, seen, states[:, :, 0], covariances, lagged)
    return motion


def _start(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray, Motion]:
    """Initial state, its covariance, and initial parameters, in proportion to the speed of the centres."""
    speed = np.mean(np.diff(centres, axis=0) ** 2)
    # The variance of a second difference is 6 times that of the observation noise, plus 2 times that of the process
    # noise of the position, plus that of the velocity.
    share = np.mean(np.diff(centres, n=2, axis=0) ** 2) / 9 + OBSERVATION_FLOOR
    mean = np.concatenate([centres[0], [0, 0]])
    return mean, np.diag([share, share, share + speed, share + speed]), Motion(share * np.eye(4), share * np.eye(2))


@kernel("float64[:,::1](float64[:,:], float64[:,:])")
def _times(one: Float64, other: Float64) -> Float64:
    """The product of two matrices."""
    product = np.zeros((one.shape[0], other.shape[1]))
    for i in range(one.shape[0]):
        for k in range(one.shape[1]):
            for j in range(other.shape[1]):
                product[i, j] += one[i, k] * other[k, j]
    return product


@kernel("float64[:,::1](float64[:,:])")
def _inverse(matrix: Float64) -> Float64:
    """The inverse of a symmetric positive definite matrix, by Gauss-Jordan elimination, which then needs no pivots."""
    size = len(matrix)
    left, inverse = matrix.copy(), np.eye(size)
    for k in range(size):
        scale = 1 / left[k, k]
        for j in range(size):
            left[k, j] *= scale
            inverse[k, j] *= scale
        for i in range(size):
            if i != k:
                factor = left[i, k]
                for j in range(size):
                    left[i, j] -= factor * left[k, j]
                    inverse[i, j] -= factor * inverse[k, j]
    return inverse


@kernel(
    "void(float64[:,::1], boolean[::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1],"
    " float64[:,:,::1], float64[:,:,::1], float64[:,:,::1])"
)
def _smooth(
    centres: Float64,
    seen: Bool,
    covariance: Float64,
    process: Float64,
    observation: Float64,
    transition: Float64,
    states: Float64,
    covariances: Float64,
    lagged: Float64,
) -> None:
    """Expectation: states given all centres, their covariances, and the covariance of each state with the next.

    A Kalman filter forwards, then the smoother of Rauch, Tung and Striebel backwards.

    Parameters
    ----------
    centres : float64 (m, 2); rows that were not `seen`, bool (m,), do not count
    covariance : float64 (4, 4), of the first state before it is measured
    states : float64 (m, 4, 1), filled; the first one is given
    covariances, lagged : float64 (m, 4, 4) and (m - 1, 4, 4), filled
    """
    m, state, ahead = len(centres), states[0].copy(), np.empty(covariances.shape)
    for k in range(m):
        if seen[k]:
            gain = _times(covariance[:, :2], _inverse(covariance[:2, :2] + observation))
            kept = np.eye(4)
            kept[:, :2] -= gain
            error = centres[k].reshape(2, 1) - state[:2]
            state = state + _times(gain, error)
            covariance = _times(_times(kept, covariance), kept.T) + _times(_times(gain, observation), gain.T)
        states[k], covariances[k] = state, covariance
        state = _times(transition, state)
        covariance = _times(_times(transition, covariance), transition.T) + process
        ahead[k] = covariance
    for k in range(m - 2, -1, -1):
        gain = _times(_times(covariances[k], transition.T), _inverse(ahead[k]))
        lagged[k] = _times(covariances[k + 1], gain.T)
        states[k] += _times(gain, states[k + 1] - _times(transition, states[k]))
        covariances[k] += _times(_times(gain, covariances[k + 1] - ahead[k]), gain.T)


def _refit(
    centres: np.ndarray, seen: np.ndarray, states: np.ndarray, covariances: np.ndarray, lagged: np.ndarray
) -> Motion:
    """Maximisation: mean outer products of the residuals, plus the uncertainty of the smoothed states."""
    push = states[1:] - states[:-1] @ TRANSITION.T
    together = (lagged @ TRANSITION.T).sum(axis=0)
    spread = covariances[1:].sum(axis=0) + TRANSITION @ covariances[:-1].sum(axis=0) @ TRANSITION.T
    process = (push.T @ push + spread - together - together.T) / len(push)

    error = centres[seen] - states[seen] @ OBSERVED.T
    observation = error.T @ error / len(error) + OBSERVED @ covariances[seen].mean(axis=0) @ OBSERVED.T
    return Motion(_floored(process, PROCESS_FLOOR), _floored(observation, OBSERVATION_FLOOR))


def _floored(covariance: Float64, floor: float) -> Float64:
    """The covariance with its eigenvalues raised to the floor: the constrained maximum of the likelihood."""
    values, vectors = np.linalg.eigh(covariance)
    root: Float64 = vectors * np.sqrt(np.maximum(values, floor))
    return root @ root.T
