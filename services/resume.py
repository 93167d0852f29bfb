"""The position at which a restarted detector continues: pure decisions from the answers of the other processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from catstream.box import Box
from catstream.messages.kinds import DetectorState, Model, ObjectPosition, Position
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


def agree(positions: Sequence[Position], models: Mapping[str, Model], desired: DesiredState) -> bool:
    """Whether the compressor and the trainer are at the same samples, so that the detectors can continue.

    Either of them may have been restarted too, and then repeats its last steps.

    Parameters
    ----------
    positions : answers of the receivers, that of the compressor first
    models : the newest model of each object that was received
    desired : the objects
    """
    versions = positions[0].versions
    needed = versions.keys() & _continuing(_last(positions), desired).keys()
    return all(name in models and models[name].version == versions[name] for name in needed)


def start(
    positions: Sequence[Position],
    models: Mapping[str, Model],
    desired: DesiredState,
    state_at: Callable[[Box, Box, int], DetectorState],
) -> Start:
    """Return the start of the detectors: after the last message that every receiver has stored.

    An object that was forgotten after that message continues too, until the message after which it was forgotten. If
    nothing was learned of any object yet, the start is before the first frame of the first of them. If nothing was
    learned of one of several objects, which takes long with the paper's first tracker only, it begins anew where it was
    last. An object of a saved model, of which the compressor has no trees, begins anew too.

    Parameters
    ----------
    positions : answers of the receivers, that of the compressor first
    models : the newest models, for which `agree` is true
    desired : the objects, and the first message of each
    state_at : returns the state of a detector from only its last box, its first box, and the number of its first frame
    """
    last, versions = _last(positions), positions[0].versions
    for name, each in _continuing(last, desired).items():
        if each.model and name not in positions[0].objects and desired.objects.get(name) == each:
            desired = desired.begun(name, each.box, last.seq + 1, each.model)
    continuing = _continuing(last, desired)
    if not versions:
        return Start(min((each.begins - 1 for each in continuing.values()), default=last.seq), desired=desired)
    objects = {}
    for name, each in continuing.items():
        found = last.objects.get(name, ObjectPosition())
        if name in versions and name in models and (state := _state(found, each, state_at)) is not None:
            objects[name] = state, models[name]
        elif not each.model and desired.objects.get(name) == each:
            desired = desired.begun(name, found.box or each.box, last.seq + 1)
    return Start(last.seq, objects, desired)


def _last(positions: Sequence[Position]) -> Position:
    """The position that every receiver has stored."""
    return min(positions, key=lambda position: position.seq)


def _continuing(last: Position, desired: DesiredState) -> dict[str, DesiredObject]:
    """The objects that began before a position and have a track in the message after it, in the order of the trees."""
    objects = {name: each for name, each in desired.objects_at(last.seq + 1).items() if each.begins <= last.seq}
    return {name: objects[name] for name in last.objects if name in objects} | objects


def _state(
    found: ObjectPosition, desired: DesiredObject, state_at: Callable[[Box, Box, int], DetectorState]
) -> DetectorState | None:
    """The state of a detector in a position; None if it is not known where the object was."""
    if found.detector is None and found.box is not None:
        return state_at(found.box, desired.box, desired.begins - 1)
    return found.detector
