"""Belief: the confidence that a detection is the object, the detector's policy at each level, and the Kalman filter.

The level combines the score of the frame with whether the object is trusted:

    lost        the score is below `belief.weak_score`: the object is reported as absent
    redetected  not trusted, with a higher score: the object is reported, but was last detected elsewhere
    weak        trusted, with a score below `belief.confident_score`
    confident   trusted, with a score of at least `belief.confident_score`

Trust is lost if a search of the whole frame detects the object away from its predicted position with a score below
`belief.trusted_score`. It returns at the first score above. Until then no model is trained with the object.

By hysteresis, a lost object returns only at `belief.confident_score` (as redetected, if it is not trusted). `policies`
is the table of the actions at each level.

The centre of the object has a Kalman filter (paper, "Classification"). While the object is present, its velocity is
constant, up to the process noise of `Motion`. While it is lost, its velocity decays and its covariance grows. A
measurement beyond a Mahalanobis distance of 6, for example of an object detected elsewhere, resets the filter, at rest.
An estimate is a float64 (5, 4): the mean of the state (x, y, vx, vy) above its covariance.

>>> motion = Motion(np.eye(4), np.eye(2))
>>> estimate = at_rest((10, 20), motion)
>>> for x in range(13, 100, 3):
...     estimate = update(predict(estimate, motion), motion, (x, 20))
>>> predict(estimate, motion)[0, :2].round(3)
array([100.,  20.])
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from catstream.base import kalman
from catstream.base.kalman import TRANSITION
from catstream.base.settings import BeliefSettings
from catstream.wire.messages import DetectorState, Level, Motion

_COASTING = TRANSITION @ np.diag([1, 1, 0.8, 0.8])  # a lost object coasts 0.8 + 0.8**2 + ... = 4 frames far
_JUMP = 6.0  # Mahalanobis distance beyond which a measured centre resets the filter
_INITIAL_VARIANCE = 100.0  # of the velocity, in process variances of a frame


@dataclass(frozen=True, slots=True)
class Policy:
    """The actions of the detector at a level of belief.

    report           report the object as present
    resize           change size and aspect ratio, and store the window as the `confident_window` of the state, whose
                     size searches of the whole frame use
    teach            cut training rows from the frame, and periodically hard negatives from all of it
    search_interval  frames from one search of the whole frame to the next, 0 for none; by the level of this frame's
                     local score (`level_of`), without hysteresis, because the search precedes `update_level`
    """

    report: bool
    resize: bool
    teach: bool
    search_interval: int


@lru_cache(maxsize=8)
def policies(interval: int) -> Mapping[Level, Policy]:
    """The policy of each level; `interval` is the setting `search.full_interval`."""
    yes, no = True, False
    return MappingProxyType(
        {  #                    report resize teach search_interval
            "lost": Policy(no, no, no, 1),
            "redetected": Policy(yes, yes, no, interval),
            "weak": Policy(yes, no, no, interval),
            "confident": Policy(yes, yes, yes, 0),
        }
    )


def level_of(score: float, trusted: bool, belief: BeliefSettings) -> Level:
    """The level of a score without hysteresis."""
    if score < belief.weak_score:
        return "lost"
    if not trusted:
        return "redetected"
    return "confident" if score >= belief.confident_score else "weak"


def update_level(state: DetectorState, score: float, redetected: bool, belief: BeliefSettings) -> DetectorState:
    """Update the level and the trust of a state by a detection."""
    trusted = (state.trusted and not redetected) or score >= belief.trusted_score
    still_lost = state.level == "lost" and score < belief.confident_score
    if state.first_window is None or still_lost:
        return replace(state, level="lost", trusted=trusted)
    return replace(state, level=level_of(score, trusted, belief), trusted=trusted)


def at_rest(centre: tuple[float, float], motion: Motion) -> np.ndarray:
    """The estimate after the first measurement of a centre: velocity 0, with a large variance."""
    estimate = np.zeros((5, 4))
    estimate[0, :2] = centre
    estimate[1:3, :2] = motion.observation
    estimate[3:, 2:] = _INITIAL_VARIANCE * motion.process[2:, 2:]
    return estimate


def predict(estimate: np.ndarray, motion: Motion, *, lost: bool = False) -> np.ndarray:
    """Prediction step of the Kalman filter: the estimate in the next frame."""
    transition = _COASTING if lost else TRANSITION
    return np.vstack(kalman.predict(estimate[0], estimate[1:], transition, motion.process))


def update(estimate: np.ndarray, motion: Motion, centre: tuple[float, float]) -> np.ndarray:
    """Update step of the Kalman filter by a measured centre."""
    x, y = (np.array(centre) - estimate[0, :2]).tolist()
    (a, b), (c, d) = (estimate[1:3, :2] + motion.observation).tolist()
    # The squared Mahalanobis distance, by the inverse of a 2 x 2 matrix, times its determinant.
    if d * x * x - (b + c) * x * y + a * y * y > _JUMP**2 * (a * d - b * c):
        return at_rest(centre, motion)
    return np.vstack(kalman.update(estimate[0], estimate[1:], np.array(centre), motion.observation))


def predict_window(state: DetectorState) -> DetectorState:
    """Move the window of a state to its predicted centre in the next frame."""
    if state.motion is None:
        return state
    if state.centre is None:
        estimate = predict(at_rest(state.window.centre, state.motion), state.motion)
    else:
        estimate = predict(state.centre, state.motion, lost=state.level == "lost")
    x, y = map(float, estimate[0, :2])
    return replace(state, centre=estimate, window=state.window.centred(x, y))


def update_motion(state: DetectorState) -> DetectorState:
    """Update the Kalman filter of a state by the centre of its window, which was measured in this frame."""
    if state.motion is None or state.centre is None:
        return state
    return replace(state, centre=update(state.centre, state.motion, state.window.centre))
