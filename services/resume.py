"""The position at which a restarted detector continues: pure decisions from the answers of the other processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from catstream.box import Box
from catstream.messages import DetectorState, Model, ObjectPosition, Position
from catstream.services.desired import DesiredObject, DesiredState

__all__ = ["Start", "agree", "start"]


@dataclass(frozen=True, slots=True)
class Start:
    """The point of a stream after which the detectors continue.

    seq      the last message that every receiver has stored
    objects  the state of the detector of each object after that message, and the model that belongs to it
    desired  the desired state from there on
    """

    seq: int
    objects: dict[str, tuple[DetectorState, Model]] = field(default_factory=dict)
    desired: DesiredState = field(default_factory=DesiredState)


def agree(features: Position, models: Mapping[str, Model], desired: DesiredState) -> bool:
    """Whether the compressor and the trainer are at the same samples, so that the detectors can continue.

    Either of them may have been restarted too, and then repeats its last steps.

    Parameters
    ----------
    features : answer of the compressor
    models : the newest model of each object that was received
    desired : the objects
    """
    return all(
        name in models and models[name].version == version
        for name, version in features.versions.items()
        if name in desired.objects
    )


def start(
    positions: Sequence[Position],
    models: Mapping[str, Model],
    desired: DesiredState,
    state_at: Callable[[Box, Box], DetectorState],
) -> Start:
    """Return the start of the detectors: after the last message that every receiver has stored.

    If nothing was learned of any object yet, it is before the first frame of the first of them. If nothing was learned
    of one of several objects, which takes long with the paper's first tracker only, it begins anew where it was last.

    Parameters
    ----------
    positions : answers of the receivers, that of the compressor first
    models : the newest models, for which `agree` is true
    desired : the objects, and the first message of each
    state_at : returns the state of a detector from only its last and its first box
    """
    learned = {name: models[name] for name in positions[0].versions if name in models}
    last = min(positions, key=lambda position: position.seq)
    if not positions[0].versions:
        begins = min((max(each.begins, 1) for each in desired.objects.values()), default=last.seq + 1)
        return Start(min(last.seq, begins - 1), desired=desired)
    objects = {}
    for name, each in desired.objects.items():
        if last.seq < max(each.begins, 1):
            continue  # it begins later
        found = last.objects.get(name, ObjectPosition())
        if name in learned and (state := _state(found, each, state_at)) is not None:
            objects[name] = state, learned[name]
        elif each.begins:
            desired = desired.begun(name, found.box or each.box, last.seq + 1)
    return Start(last.seq, objects, desired)


def _state(
    found: ObjectPosition, desired: DesiredObject, state_at: Callable[[Box, Box], DetectorState]
) -> DetectorState | None:
    """The state of a detector in a position; None if it is not known where the object was."""
    if found.detector is None and found.box is not None:
        return state_at(found.box, desired.box)
    return found.detector
