"""Belief: how sure the detector is that a detection is the object, and what it does at each level.

    lost        the score is too low: the object is reported as absent
    redetected  found by a search of the whole frame, away from where it was expected, and not trusted yet
    weak        found where it was expected, with a low score
    confident   found where it was expected, with a high score

`policies` is the table of what each level does. A redetected object is trusted, and so becomes weak or confident, once
it scores `belief.trust_score`: until then no model is trained with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

from catstream.messages import DetectorState, Level
from catstream.settings import BeliefSettings, Settings

__all__ = ["ALWAYS", "NEVER", "Policy", "is_redetection", "level_of", "policies", "updated"]

ALWAYS, NEVER = -math.inf, math.inf  #: a score from which on something is done
_USUAL_RATE = 0.01  # weight of a frame in the running mean of the object's score


@dataclass(frozen=True, slots=True)
class Policy:
    """What the detector does at a level of belief; an action is taken from a score on, `ALWAYS` or `NEVER`.

    reported         whether the object counts as present
    search_interval  frames from one search of the whole frame to the next, 0 for none
    resize           the score from which on size and aspect ratio change
    recentre         from which on the centroid of the colours is updated, and the window shifted to it
    remember         from which on the window is remembered as the last confident one
    teach            from which on training rows are cut from the frame
    mine             from which on hard negatives are searched for in the whole frame
    """

    reported: bool
    search_interval: int
    resize: float
    recentre: float
    remember: float
    teach: float
    mine: float


@lru_cache(maxsize=8)
def policies(settings: Settings) -> Mapping[Level, Policy]:
    """The table: what the detector does at each level of belief."""
    belief, each = settings.belief, settings.search.whole_interval
    extent, sure, teach, mine = belief.extent_score, belief.confident_score, belief.teach_score, belief.mine_score
    return MappingProxyType(
        {  #                    reported search  resize  recentre remember teach  mine
            "lost": Policy(False, 1, NEVER, NEVER, NEVER, NEVER, NEVER),
            "redetected": Policy(True, each, extent, NEVER, sure, NEVER, NEVER),
            "weak": Policy(True, each, extent, extent, NEVER, teach, mine),
            "confident": Policy(True, 0, extent, extent, ALWAYS, teach, mine),
        }
    )


def level_of(score: float, least: float, trusted: bool, belief: BeliefSettings) -> Level:
    """The level of a score: lost below `least`."""
    if score < least:
        return "lost"
    if not trusted:
        return "redetected"
    return "confident" if score >= belief.confident_score else "weak"


def updated(state: DetectorState, score: float, redetected: bool, belief: BeliefSettings) -> DetectorState:
    """The state after a detection: level, trust and the object's usual score.

    A lost object returns at a higher score than a present one needs to stay (hysteresis). Both thresholds rise in
    proportion to the score that the object usually has.
    """
    trusted = (state.trusted and not redetected) or score >= belief.trust_score
    if state.level == "lost":
        least = max(belief.return_score, belief.return_share * state.usual_score)
    else:
        least = max(belief.present_score, belief.present_share * state.usual_score)
    if state.first_window is None or score < least:
        return replace(state, level="lost", trusted=trusted)
    usual = state.usual_score + _USUAL_RATE * (score - state.usual_score)
    return replace(state, level=level_of(score, least, trusted, belief), trusted=trusted, usual_score=usual)


def is_redetection(score: float, near: float, belief: BeliefSettings) -> bool:
    """Whether the best window of the whole frame replaces the best one near: its score has to lead clearly."""
    return score > belief.return_score and score > near + belief.jump_margin
