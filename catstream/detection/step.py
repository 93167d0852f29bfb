"""The steps of a detector from one frame to the next: look, settle, teach (paper, "Classification").

These are pure functions: the same state, frame, model and settings give the same result.
"""

from __future__ import annotations

from dataclasses import replace

from catstream.detection import belief, extent, motion, search, teacher
from catstream.detection.likeness import Likeness
from catstream.detection.search import Detection
from catstream.detection.teacher import Training
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import DetectorState, Model
from catstream.settings import Settings

__all__ = ["looked", "settled", "taught"]


def looked(
    state: DetectorState, frame: Pyramid, seq: int, model: Model, likeness: Likeness | None, settings: Settings
) -> tuple[DetectorState, Detection]:
    """Search the object in the next frame.

    Costs the same for every frame: a few small patches around the object, and the whole frame if the belief is low (or
    always, if `search.mode` is "full").

    Parameters
    ----------
    likeness : to the object of a saved model, which is sought in the whole frame as long as it has not been found

    Returns
    -------
    the state with the place that was expected, and the detection
    """
    state = motion.expected(state)
    if state.first_window is None and likeness is not None:
        return search.seek(frame, state, seq, model, likeness, settings)
    return state, search.find(frame, state, seq, model, settings)


def settled(state: DetectorState, found: Detection, size: tuple[int, int], settings: Settings) -> DetectorState:
    """The state after a detection: its belief in it, and the window moved as far as the belief allows.

    Parameters
    ----------
    size : width and height of the frame
    """
    state = belief.updated(state, found.score, found.redetected, settings.belief)
    policy = _policy(state, settings)
    if not policy.report:
        return state
    window = extent.followed(state.window, found.window, policy.resize).with_centre_in(*size)
    confident = window if policy.resize else state.confident_window
    return motion.observed(replace(state, window=window, confident_window=confident))


def taught(
    state: DetectorState,
    found: Detection,
    frame: Pyramid,
    seq: int,
    model: Model,
    likeness: Likeness | None,
    settings: Settings,
) -> Training:
    """The training rows of a frame, as far as the belief in its detection allows."""
    if state.first_window is None and likeness is not None:
        return teacher.training_beside(frame, found.window, model, likeness, settings)
    if not _policy(state, settings).teach:
        return {}
    return teacher.training_of(frame, state.window, found.around, seq, model, settings)


def _policy(state: DetectorState, settings: Settings) -> belief.Policy:
    return belief.policies(settings.search.whole_interval)[state.level]
