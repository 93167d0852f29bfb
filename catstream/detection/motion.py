"""Motion: a Kalman filter of the object's centre (paper, "Classification").

While the object is present it moves at constant velocity, but for the random changes that `Motion` allows. While it is
lost, its velocity decays and its estimate grows less certain. A measured centre that the motion all but rules out, as
of an object found again elsewhere, resets the filter, at rest.

An estimate is a float64 (5, 4): the mean of the state (x, y, vx, vy) above its covariance.

>>> motion = Motion(np.eye(4), np.eye(2))
>>> estimate = at_rest((10, 20), motion)
>>> for x in range(13, 100, 3):
...     estimate = measured(predicted(estimate, motion), motion, (x, 20))
>>> predicted(estimate, motion)[0, :2].round(3)
array([100.,  20.])
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from catstream.messages.kinds import DetectorState, Motion
from catstream.numerics import kalman
from catstream.numerics.kalman import TRANSITION

_COASTING = TRANSITION @ np.diag([1, 1, 0.8, 0.8])  # of a lost object: 0.8 + 0.8**2 + ... = the way of 4 frames in all
_JUMP = 6.0  # Mahalanobis distance beyond which a measured centre resets the filter
_UNKNOWN_SPEED = 100.0  # variance of a velocity that has not been measured yet, in process variances of a frame


def at_rest(centre: tuple[float, float], motion: Motion) -> np.ndarray:
    """The estimate of an object that has been measured once."""
    estimate = np.zeros((5, 4))
    estimate[0, :2] = centre
    estimate[1:3, :2] = motion.observation
    estimate[3:, 2:] = _UNKNOWN_SPEED * motion.process[2:, 2:]
    return estimate


def predicted(estimate: np.ndarray, motion: Motion, *, lost: bool = False) -> np.ndarray:
    """The estimate in the next frame."""
    return np.vstack(kalman.predicted(estimate[0], estimate[1:], _COASTING if lost else TRANSITION, motion.process))


def measured(estimate: np.ndarray, motion: Motion, centre: tuple[float, float]) -> np.ndarray:
    """The estimate after a measurement of x and y in this frame."""
    x, y = (np.array(centre) - estimate[0, :2]).tolist()
    (a, b), (c, d) = (estimate[1:3, :2] + motion.observation).tolist()
    if d * x * x - (b + c) * x * y + a * y * y > _JUMP**2 * (a * d - b * c):  # the distance by the inverse of 2 x 2
        return at_rest(centre, motion)
    return np.vstack(kalman.updated(estimate[0], estimate[1:], np.array(centre), motion.observation))


def expected(state: DetectorState) -> DetectorState:
    """The state with the window moved to where the motion takes it in the next frame."""
    if state.motion is None:
        return state
    if state.centre is None:
        estimate = predicted(at_rest(state.window.centre, state.motion), state.motion)
    else:
        estimate = predicted(state.centre, state.motion, lost=state.level == "lost")
    x, y = map(float, estimate[0, :2])
    return replace(state, centre=estimate, window=state.window.centred(x, y))


def observed(state: DetectorState) -> DetectorState:
    """The state after its window was measured in this frame."""
    if state.motion is None or state.centre is None:
        return state
    return replace(state, centre=measured(state.centre, state.motion, state.window.centre))
