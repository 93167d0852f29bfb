"""From where a detector goes on that takes the place of another one: pure decisions over what the others answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from catstream.box import Box
from catstream.messages import DetectorState, Model, Position
from catstream.services.desired import DesiredState

__all__ = ["Start", "agree", "start"]


@dataclass(frozen=True, slots=True)
class Start:
    """The point of a stream from which a detector goes on.

    seq       the last message that every receiver has stored
    detector  state of the detector after that message, None if the object begins anew
    model     the model that belongs to that state, None if the object begins anew
    """

    seq: int
    detector: DetectorState | None = None
    model: Model | None = None


def agree(features: Position, model: Model | None) -> bool:
    """Whether the compressor and the trainer are at the same sample, so that the detector can go on.

    Either of them may have died too, and repeats then what it has done.

    Parameters
    ----------
    features : what the compressor answered
    model : the newest model that arrived, None before the first
    """
    return not features.version or (model is not None and model.version == features.version)


def start(
    positions: Sequence[Position],
    model: Model | None,
    desired: DesiredState,
    state_at: Callable[[Box, Box], DetectorState],
) -> Start:
    """From where the detector goes on: after the last message that every receiver has stored.

    If nothing was learned of the present object yet, it goes on from the first frame of that object.

    Parameters
    ----------
    positions : what the receivers answered, the compressor first
    model : the newest model, for which `agree` holds
    desired : the object and its first message
    state_at : state of a detector of which only the last and the first box are known
    """
    begins = max(desired.begins, 1)
    last = min(positions, key=lambda position: position.seq)
    if not positions[0].version:
        return Start(min(last.seq, begins - 1))
    state = last.detector
    if state is None and last.box is not None and desired.box is not None:
        state = state_at(last.box, desired.box)
    if last.seq < begins or state is None or model is None:
        return Start(last.seq)
    return Start(last.seq, state, model)
