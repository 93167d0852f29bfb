"""Belief: how sure the detector is that a detection is the object, and its behaviour at each level.

The level combines two facts, the score of the frame and whether the object is trusted:

    lost        the score is below `belief.weak_score`: the object is reported as absent
    redetected  any score from there; the object is reported, but not trusted since it was found elsewhere
    weak        trusted, with a score below `belief.confident_score`
    confident   trusted, with a score from `belief.confident_score`

Trust is lost if a search of the whole frame finds the object away from the expected place with a score below
`belief.trusted_score`. It returns at the first score from there. Until then no model is trained with the object.

A lost object returns at `belief.confident_score` only (as redetected, if it is not trusted), which is hysteresis.
`policies` is the table of the actions at each level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

from catstream.messages.kinds import DetectorState, Level
from catstream.settings import BeliefSettings


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
