"""The motion of a centre: a Kalman filter of filterpy, with the matrices of constant velocity.

The state is (x, y, vx, vy), in pixels and pixels a frame; x and y are measured. The detector filters with it, and the
trainer smooths with it.
"""

from __future__ import annotations

from functools import cache
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter

__all__ = ["OBSERVED", "TRANSITION", "constant_velocity", "prepare"]

TRANSITION = np.eye(4) + np.eye(4, k=2)  #: each position moves on by its velocity
OBSERVED = np.eye(2, 4)  #: of the state, x and y are measured


@cache
def prepare() -> None:
    """Import filterpy in a thread, once; returns at once.

    filterpy imports scipy.stats, which takes half a second. A filter that is needed meanwhile waits for the import, so
    that no result depends on its end.
    """
    Thread(target=_imported, name="filterpy").start()  # no daemon: an interpreter must not end inside an import


def constant_velocity(
    mean: np.ndarray, covariance: np.ndarray, process: np.ndarray, observation: np.ndarray
) -> KalmanFilter:
    """A Kalman filter of a centre that moves at constant velocity, but for random changes of its state.

    Parameters
    ----------
    mean : float64 (4,), the state
    covariance : float64 (4, 4), of the state
    process : float64 (4, 4), covariance of the change of the state in a frame
    observation : float64 (2, 2), covariance of the error of a measured centre

    >>> kalman = constant_velocity(np.array([10.0, 20, 3, 0]), np.eye(4), np.eye(4), np.eye(2))
    >>> kalman.predict()
    >>> kalman.x
    array([13., 20.,  3.,  0.])
    """
    kalman = _imported()(dim_x=4, dim_z=2)
    kalman.F, kalman.H = TRANSITION, OBSERVED
    kalman.x, kalman.P, kalman.Q, kalman.R = mean, covariance, process, observation
    return kalman


def _imported() -> type[KalmanFilter]:
    from filterpy.kalman import KalmanFilter

    kind: type[KalmanFilter] = KalmanFilter
    return kind
