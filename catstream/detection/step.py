"""A step of the detector: from one frame to the next (paper, "Classification").

`step` is a pure function: the same state, frame, model and settings give the same result.
"""

from __future__ import annotations

from dataclasses import replace

from catstream.detection import belief, colour_centroid, extent, motion, search, teacher
from catstream.detection.search import Detection
from catstream.detection.teacher import Training
from catstream.features.cells import COLOURS
from catstream.features.pyramid import Pyramid
from catstream.messages import DetectorState, Model, State, Track
from catstream.settings import Settings

__all__ = ["step", "track_of"]


def step(
    state: DetectorState,
    frame: Pyramid,
    seq: int,
    time: float,
    model: Model,
    settings: Settings,
    found: Detection | None = None,
) -> tuple[DetectorState, Track, Training]:
    """Find the object in the next frame, and cut the training rows that the belief in the detection allows.

    Costs the same for every frame: a few small patches around the object, and the whole frame if the belief is low (or
    always, if `search.mode` is "full").

    Parameters
    ----------
    seq, time : of the frame's messages
    found : what the paper's first tracker found, in place of a search; it never reports the object as absent
    """
    if found is not None:
        level = belief.level_of(max(found.score, settings.belief.weak_score), True, settings.belief)
        state = replace(state, level=level, window=found.window)
    else:
        state = motion.expected(state)
        state, found = search.searched(frame, state, seq, model, settings)
        state = belief.updated(state, found.score, found.redetected, settings.belief)
        if _policy(state, settings).report:
            state = _followed(state, found, frame.size, model, settings)
            state = motion.observed(state)
    training = {}
    if _policy(state, settings).teach:
        training = teacher.training_of(frame, state.window, found.around, seq, model, settings)
    return state, track_of(state, seq, time, found.score, model, settings), training


def _followed(
    state: DetectorState, found: Detection, size: tuple[int, int], model: Model, settings: Settings
) -> DetectorState:
    """The state with the window moved to a detection, as far as the belief in it allows."""
    policy, colours = _policy(state, settings), state.colour_centroid
    window = extent.followed(state.window, found.window, policy.resize)
    if found.around is not None and policy.recentre:
        slack, weights = settings.extent.colour_slack, model.weights[COLOURS]
        colours, window = colour_centroid.recentred(colours, window, found.around, weights, slack)
    window = window.with_centre_in(*size)
    confident = window if policy.remember else state.confident_window
    return replace(state, window=window, confident_window=confident, colour_centroid=colours)


def track_of(state: DetectorState, seq: int, time: float, score: float, model: Model, settings: Settings) -> Track:
    """The reported box of a state, unless the level of belief forbids it."""
    reported = _policy(state, settings).report
    box = state.window.box(settings.search.context) if reported else None
    present: State = "present" if model.version else "bootstrapping"
    return Track(seq, seq - 1, time, present if reported else "absent", box, float(score), model.version)


def _policy(state: DetectorState, settings: Settings) -> belief.Policy:
    return belief.policies(settings.search.whole_interval)[state.level]
