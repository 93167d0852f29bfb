"""Expectation maximisation of the parameters of the Kalman filter (paper, "Classification").

The model is linear and Gaussian: the centre of the object moves at constant velocity with process noise, and is
measured with observation noise. EM estimates the covariances of both from the measured centres.
"""

from __future__ import annotations

import numpy as np

from catstream.base.arrays import Bool, Float64
from catstream.base.kalman import OBSERVATION, TRANSITION
from catstream.wire.messages import Motion

FEWEST = 8  #: minimum number of centres for the estimation of 13 free parameters
PROCESS_FLOOR = 1e-4  #: smallest variance of the process, pixels squared: 0.01 pixels a frame
OBSERVATION_FLOOR = 1e-2  #: smallest variance of a measured centre, pixels squared: 0.1 pixels


def prepare() -> None:
    """Import filterpy in advance, which takes most of a second; otherwise, the first estimate imports it."""
    import filterpy.kalman  # noqa: F401


def learn_motion(centres: np.ndarray, iterations: int = 5) -> Motion | None:
    """Estimate the covariances of the constant-velocity model from centres, by maximum likelihood.

    No iteration lowers the likelihood. The covariances are symmetric, and their eigenvalues are at least
    `PROCESS_FLOOR` and `OBSERVATION_FLOOR`, so that the filter also works for a motionless object. Costs O(m) an
    iteration, about 50 microseconds a frame.

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
    present = np.flatnonzero(_present(centres))
    if len(present) < FEWEST:
        return None
    mean, covariance, motion = _start(centres[present])
    # Frames before the first centre and after the last carry no information.
    centres = centres[present[0] : present[-1] + 1]
    for _ in range(iterations):
        motion = _refit(centres, *_smooth(centres, mean, covariance, motion))
    return motion


def _start(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray, Motion]:
    """Initial state, its covariance, and initial parameters, in proportion to the speed of the centres."""
    speed = np.mean(np.diff(centres, axis=0) ** 2)
    # Variances: a second difference = 6 x observation noise + 2 x process noise of the position + process noise of
    # the velocity.
    share = np.mean(np.diff(centres, n=2, axis=0) ** 2) / 9 + OBSERVATION_FLOOR
    mean = np.concatenate([centres[0], [0, 0]])
    return mean, np.diag([share, share, share + speed, share + speed]), Motion(share * np.eye(4), share * np.eye(2))


def _smooth(
    centres: np.ndarray, mean: np.ndarray, covariance: np.ndarray, motion: Motion
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Expectation: smoothed states (m, 4), their covariances (m, 4, 4), and the lagged covariances (m - 1, 4, 4).

    A Kalman filter forwards, then the smoother of Rauch, Tung and Striebel backwards.
    """
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.F, kalman.H, kalman.Q, kalman.R = TRANSITION, OBSERVATION, motion.process, motion.observation
    kalman.x, kalman.P, kalman.inv = mean, covariance, _inverse
    measured = [centre if present else None for centre, present in zip(centres, _present(centres), strict=True)]
    states, covariances, _, predicted = kalman.batch_filter(measured, update_first=True)
    # The smoother inverts each predicted covariance, the newest first: one call for all is faster.
    inverses = iter(np.linalg.inv(predicted[-2::-1]))
    states, covariances, gains, _ = kalman.rts_smoother(states, covariances, inv=lambda _: next(inverses))
    return states, covariances, covariances[1:] @ gains[:-1].transpose(0, 2, 1)


def _refit(centres: np.ndarray, states: np.ndarray, covariances: np.ndarray, lagged: np.ndarray) -> Motion:
    """Maximisation: mean outer products of the residuals, plus the uncertainty of the smoothed states."""
    noise = states[1:] - states[:-1] @ TRANSITION.T
    cross = (lagged @ TRANSITION.T).sum(axis=0)
    spread = covariances[1:].sum(axis=0) + TRANSITION @ covariances[:-1].sum(axis=0) @ TRANSITION.T
    process = (noise.T @ noise + spread - cross - cross.T) / len(noise)

    present = _present(centres)
    error = centres[present] - states[present] @ OBSERVATION.T
    observation = error.T @ error / len(error) + OBSERVATION @ covariances[present].mean(axis=0) @ OBSERVATION.T
    return Motion(_floored(process, PROCESS_FLOOR), _floored(observation, OBSERVATION_FLOOR))


def _present(centres: np.ndarray) -> Bool:
    """Mask of the measured centres, (m,)."""
    present: Bool = np.isfinite(centres).all(axis=1)
    return present


def _inverse(matrix: Float64) -> Float64:
    """The inverse of a matrix of shape (2, 2), in a quarter of the time of `np.linalg.inv`."""
    (a, b), (c, d) = matrix.tolist()
    inverse: Float64 = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    return inverse


def _floored(covariance: Float64, floor: float) -> Float64:
    """The covariance with its eigenvalues raised to the floor: the constrained maximum of the likelihood."""
    values, vectors = np.linalg.eigh(covariance)
    root: Float64 = vectors * np.sqrt(np.maximum(values, floor))
    return root @ root.T
