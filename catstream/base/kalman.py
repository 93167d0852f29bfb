"""The motion of a centre: a Kalman filter with a constant-velocity model.

The state is (x, y, vx, vy), in pixels and pixels a frame; x and y are measured. The results equal filterpy's, bit
for bit, but filterpy takes a second to import. The trainer smooths with filterpy.
"""

from __future__ import annotations

import numpy as np

TRANSITION = np.eye(4) + np.eye(4, k=2)  #: adds the velocity to the position
OBSERVATION = np.eye(2, 4)  #: selects x and y, which are measured


def predict(
    mean: np.ndarray, covariance: np.ndarray, transition: np.ndarray, process: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Prediction step: mean and covariance of the state in the next frame.

    >>> predict(np.array([10.0, 20, 3, 0]), np.eye(4), TRANSITION, np.eye(4))[0]
    array([13., 20.,  3.,  0.])
    """
    return transition @ mean, transition @ covariance @ transition.T + process


def update(
    mean: np.ndarray, covariance: np.ndarray, centre: np.ndarray, observation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Update step: mean and covariance of the state after a measurement of x and y, float64 (2,)."""
    innovation = OBSERVATION @ covariance @ OBSERVATION.T + observation
    gain = covariance @ OBSERVATION.T @ np.linalg.inv(innovation)
    rest = np.eye(4) - gain @ OBSERVATION
    covariance = rest @ covariance @ rest.T + gain @ observation @ gain.T  # Joseph form: stays symmetric
    return mean + gain @ (centre - OBSERVATION @ mean), covariance
