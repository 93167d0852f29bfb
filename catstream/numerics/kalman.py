"""The motion of a centre: a Kalman filter of filterpy, with the matrices of constant velocity.

The state is (x, y, vx, vy), in pixels and pixels a frame; x and y are measured. The detector filters with it, and the
trainer smooths with it.
"""

from __future__ import annotations

import numpy as np
from filterpy import kalman
from filterpy.kalman import KalmanFilter

TRANSITION = np.eye(4) + np.eye(4, k=2)  #: each position moves on by its velocity
OBSERVED = np.eye(2, 4)  #: of the state, x and y are measured


def constant_velocity(
    mean: np.ndarray, covariance: np.ndarray, process: np.ndarray, observation: np.ndarray
) -> KalmanFilter:
    """A Kalman filter of a centre that moves at constant velocity, but for random changes of its state.

    The covariances are of the state, of its change in a frame, and of the error of a measured centre.

    >>> kalman = constant_velocity(np.array([10.0, 20, 3, 0]), np.eye(4), np.eye(4), np.eye(2))
    >>> kalman.predict()
    >>> kalman.x
    array([13., 20.,  3.,  0.])
    """
    made = KalmanFilter(dim_x=4, dim_z=2)
    made.F, made.H = TRANSITION, OBSERVED
    made.x, made.P, made.Q, made.R = mean, covariance, process, observation
    return made


def predicted(
    mean: np.ndarray, covariance: np.ndarray, transition: np.ndarray, process: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the state in the next frame, without the working space of a filter's object."""
    mean, covariance = kalman.predict(mean, covariance, transition, process)
    return mean, covariance


def updated(
    mean: np.ndarray, covariance: np.ndarray, measured: np.ndarray, observation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the state after a measurement of x and y, float64 (2,)."""
    mean, covariance = kalman.update(mean, covariance, measured, observation, OBSERVED)
    return mean, covariance
