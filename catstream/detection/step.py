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
from catstream.messages.kinds import DetectorState, Model, State, Track
from catstream.settings import Settings

__all__ = ["looked", "settled", "taught", "track_of"]


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
    if _policy(state, settings).report:
        state = motion.observed(_followed(state, found, size, settings))
    return state


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


def _followed(state: DetectorState, found: Detection, size: tuple[int, int], settings: Settings) -> DetectorState:
    """The state with the window moved to a detection, as far as the belief in it allows."""
    resize = _policy(state, settings).resize
    window = extent.followed(state.window, found.window, resize).with_centre_in(*size)
    return replace(state, window=window, confident_window=window if resize else state.confident_window)


def track_of(
    state: DetectorState, seq: int, time: float, score: float, model: Model, settings: Settings, name: str
) -> Track:
    """The reported box of a state, unless the level of belief forbids it."""
    reported = _policy(state, settings).report
    box = state.window.box(settings.search.context) if reported else None
    present: State = "present" if model.version else "bootstrapping"
    shown: State = present if reported else "absent"
    began = state.first_frame
    return Track(seq, seq - 1, time, shown, box, float(score), model.version, object=name, began=began)


def _policy(state: DetectorState, settings: Settings) -> belief.Policy:
    return belief.policies(settings.search.whole_interval)[state.level]
