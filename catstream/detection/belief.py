"""Belief: how sure the detector is that a detection is the object, what it does at each level, and the Kalman filter.

The level combines two facts, the score of the frame and whether the object is trusted:

    lost        the score is below `belief.weak_score`: the object is reported as absent
    redetected  any score from there; the object is reported, but not trusted since it was found elsewhere
    weak        trusted, with a score below `belief.confident_score`
    confident   trusted, with a score from `belief.confident_score`

Trust is lost if a search of the whole frame finds the object away from the expected place with a score below
`belief.trusted_score`. It returns at the first score from there. Until then no model is trained with the object.

A lost object returns at `belief.confident_score` only (as redetected, if it is not trusted), which is hysteresis.
`policies` is the table of the actions at each level.

The centre of the object has a Kalman filter (paper, "Classification"). While the object is present it moves at constant
velocity, but for the random changes that `Motion` allows. While it is lost, its velocity decays and its estimate grows
less certain. A measured centre that the motion all but rules out, as of an object found again elsewhere, resets the
filter, at rest. An estimate is a float64 (5, 4): the mean of the state (x, y, vx, vy) above its covariance.

>>> motion = Motion(np.eye(4), np.eye(2))
>>> estimate = at_rest((10, 20), motion)
>>> for x in range(13, 100, 3):
...     estimate = measured(predicted(estimate, motion), motion, (x, 20))
>>> predicted(estimate, motion)[0, :2].round(3)
array([100.,  20.])
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from catstream.base.settings import BeliefSettings
from catstream.messages.kinds import DetectorState, Level, Motion
from catstream.numerics import kalman
from catstream.numerics.kalman import TRANSITION

_COASTING = TRANSITION @ np.diag([1, 1, 0.8, 0.8])  # of a lost object: 0.8 + 0.8**2 + ... = the way of 4 frames in all
_JUMP = 6.0  # Mahalanobis distance beyond which a measured centre resets the filter
_UNKNOWN_SPEED = 100.0  # variance of a velocity that has not been measured yet, in process variances of a frame


@dataclass(frozen=True, slots=True)
class Policy:
    """The behaviour of the detector at a level of belief.

    report           the object counts as present
    resize           size and aspect ratio change, and the window becomes the `confident_window` of the state, whose
                     size searches of the whole frame use
    teach            training rows are cut from the frame, and now and then hard negatives from all of it
    search_interval  frames from one search of the whole frame to the next, 0 for none; looked up by the level of the
                     local score of this frame (`level_of`), without hysteresis, because the search precedes `updated`
    """

    report: bool
    resize: bool
    teach: bool
    search_interval: int


@lru_cache(maxsize=8)
def policies(interval: int) -> Mapping[Level, Policy]:
    """The behaviour of the detector at each level; `interval` is the setting `search.whole_interval`.

    The search interval applies to the level of this frame's local score, without hysteresis; all else to the level of
    the state after the frame.
    """
    no, yes = False, True
    return MappingProxyType(
        {  #                    report resize teach search_interval
            "lost": Policy(no, no, no, 1),
            "redetected": Policy(yes, yes, no, interval),
            "weak": Policy(yes, no, no, interval),
            "confident": Policy(yes, yes, yes, 0),
        }
    )


def level_of(score: float, trusted: bool, belief: BeliefSettings) -> Level:
    """The level of a score by itself, without the hysteresis of `updated`."""
    if score < belief.weak_score:
        return "lost"
    if not trusted:
        return "redetected"
    return "confident" if score >= belief.confident_score else "weak"


def updated(state: DetectorState, score: float, redetected: bool, belief: BeliefSettings) -> DetectorState:
    """The state after a detection: its level and whether it is trusted."""
    trusted = (state.trusted and not redetected) or score >= belief.trusted_score
    still_lost = state.level == "lost" and score < belief.confident_score
    if state.first_window is None or still_lost:
        return replace(state, level="lost", trusted=trusted)
    return replace(state, level=level_of(score, trusted, belief), trusted=trusted)


def is_redetection(score: float, near: float, belief: BeliefSettings) -> bool:
    """Whether the best window of the whole frame replaces the best one near: it is confident, and leads clearly."""
    return score > belief.confident_score and score > near + belief.jump_margin


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
