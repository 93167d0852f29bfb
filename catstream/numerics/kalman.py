"""The motion of a centre: the Kalman filter of filterpy, with a constant-velocity model.

The state is (x, y, vx, vy), in pixels and pixels a frame; x and y are measured. The detector filters with it, and the
trainer smooths with it.
"""

from __future__ import annotations

import numpy as np
from filterpy import kalman
from filterpy.kalman import KalmanFilter

TRANSITION = np.eye(4) + np.eye(4, k=2)  #: adds the velocity to the position
OBSERVATION = np.eye(2, 4)  #: selects x and y, which are measured


def constant_velocity(
    mean: np.ndarray, covariance: np.ndarray, process: np.ndarray, observation: np.ndarray
) -> KalmanFilter:
    """A Kalman filter of a centre with constant velocity.

    The matrices are the covariance of the state, of the process noise in a frame, and of the observation noise.

    >>> kalman = constant_velocity(np.array([10.0, 20, 3, 0]), np.eye(4), np.eye(4), np.eye(2))
    >>> kalman.predict()
    >>> kalman.x
    array([13., 20.,  3.,  0.])
    """
    model = KalmanFilter(dim_x=4, dim_z=2)
    model.F = TRANSITION
    model.H = OBSERVATION
    model.x = mean
    model.P = covariance
    model.Q = process
    model.R = observation
    return model


def predict(
    mean: np.ndarray, covariance: np.ndarray, transition: np.ndarray, process: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Prediction step: mean and covariance of the state in the next frame."""
    mean, covariance = kalman.predict(mean, covariance, transition, process)
    return mean, covariance


def update(
    mean: np.ndarray, covariance: np.ndarray, centre: np.ndarray, observation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Update step: mean and covariance of the state after a measurement of x and y, float64 (2,)."""
    mean, covariance = kalman.update(mean, covariance, centre, observation, OBSERVATION)
    return mean, covariance
