"""The position at which a restarted detector continues: pure decisions from the answers of the other processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from catstream.box import Box
from catstream.messages import DetectorState, Model, Position
from catstream.services.desired import DesiredState

__all__ = ["Start", "agree", "start"]


@dataclass(frozen=True, slots=True)
class Start:
    """The point of a stream after which a detector continues.

    seq       the last message that every receiver has stored
    detector  state of the detector after that message; None if tracking starts anew
    model     the model that belongs to that state; None if tracking starts anew
    """

    seq: int
    detector: DetectorState | None = None
    model: Model | None = None


def agree(features: Position, model: Model | None) -> bool:
    """Whether the compressor and the trainer are at the same sample, so that the detector can continue.

    Either of them may have been restarted too, and then repeats its last steps.

    Parameters
    ----------
    features : answer of the compressor
    model : the newest model that was received, None before the first
    """
    return not features.version or (model is not None and model.version == features.version)


def start(
    positions: Sequence[Position],
    model: Model | None,
    desired: DesiredState,
    state_at: Callable[[Box, Box], DetectorState],
) -> Start:
    """Return the start of the detector: after the last message that every receiver has stored.

    If nothing was learned of the current object yet, it starts at the first frame of that object.

    Parameters
    ----------
    positions : answers of the receivers, that of the compressor first
    model : the newest model, for which `agree` is true
    desired : the object and its first message
    state_at : returns the state of a detector from only its last and its first box
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
