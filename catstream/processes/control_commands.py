"""What a command changes, and what it is answered: pure functions."""

from __future__ import annotations

from dataclasses import replace

from catstream.base.names import UNNAMED, check_count, check_name
from catstream.base.text import listed
from catstream.detection.objects import Detectors
from catstream.errors import ObjectError
from catstream.jobs.saved_model import check_sizes
from catstream.messages.kinds import Answer, Command
from catstream.processes.decisions import DesiredObject, DesiredState

#: The reason of a stream's end, if a command stopped it.
STOPPED = "it was stopped by a command"


def carried_out(
    command: Command, desired: DesiredState, detectors: Detectors, model: DesiredObject | None = None
) -> tuple[DesiredState, Answer]:
    """The desired state after a command that needs no frame, and the answer; `model` begins an object for `search`.

    ObjectError or SettingsError if it cannot be carried out. The `detectors` are not changed.
    """
    name, seq, seconds = command.object, detectors.seq, command.seconds or 0.0
    after = f"after frame {seq - 1}" if seq else "before the first frame"
    match command.verb:
        case "pause" if desired.paused or command.seconds is None:
            desired, effect = replace(desired, paused=True), f"paused {after}"
        case "pause" if seconds > 0:  # it ends by itself, and changes nothing that is kept
            effect = f"paused for {seconds:g} s {after}"
        case "pause" | "resume":
            desired = replace(desired, paused=False)
            effect = "waiting for a box" if desired.holds else f"resumed {after}"
        case "stop":
            desired, effect = replace(desired, stopped=True), f"the stream ends {after}"
        case "search":
            name = object_of(command, desired)
            check_room(name, desired, detectors.settings.run.objects_most)
            if model is None:
                raise ObjectError("a search needs a saved model: give the file of one")
            desired = desired.begun(name, replace(model, begins=seq + 1))
            check_sizes({name: each.size for name, each in desired.objects.items() if each.begins > seq and each.model})
            effect = f"{listed([name])} is searched for from frame {seq} on, by model {model.version}"
        case "forget":
            name = _tracked(command, desired)
            desired = desired.without(name)
            waits = "" if desired.objects else ": no object is left, so the run waits for a box"
            effect = f"{listed([name])} is no longer tracked {after}{waits}"
            return desired, replace(answer(command, detectors, True, effect, name), box=None, version=0)
        case _:  # "save": the client writes the file
            name = _tracked(command, desired)
            known = detectors.detectors.get(name)
            if known is None or known.state is None or not known.model.version:
                why = "nothing was learned of the object yet: try again once there is a model (catstream status)"
                return desired, answer(command, detectors, False, why, name)
            if known.state.is_sought:
                why = "the object of the saved model was not found yet: try again once it was"
                return desired, answer(command, detectors, False, why, name)
            effect = f"model {known.model.version} {after}"
    return desired, answer(command, detectors, True, effect, name)


def answer(
    command: Command, detectors: Detectors, done: bool, reason: str, name: str | None = None, frame: int | None = None
) -> Answer:
    """The answer to a command for the object `name`, by default that of the command."""
    name = command.object if name is None else name
    frame = max(detectors.seq - 1, 0) if frame is None else frame
    known = detectors.detectors.get(name)
    box, version = (known.box, known.model.version) if known is not None else (None, 0)
    return Answer(command.id, done, reason, frame, box, version, name)


def object_of(command: Command, desired: DesiredState) -> str:
    """The name of the object that a command is for: without a name, the object that has none, or the only one."""
    names = desired.objects
    if command.object or not names or UNNAMED in names:
        return check_name(command.object)
    if len(names) > 1:
        raise ObjectError(f"which object? This run has {listed(names)}: give a name")
    return next(iter(names))


def check_room(name: str, desired: DesiredState, most: int) -> None:
    """Raise ObjectError if there is no room for an object of this name."""
    if name not in desired.objects:
        check_count(len(desired.objects) + 1, most)


def is_kept(command: Command, name: str, desired: DesiredState, detectors: Detectors) -> bool:
    """Whether a box is for the same object; one without a model has nothing that could be kept."""
    known, each = detectors.detectors.get(name), desired.objects.get(name)
    return command.keep and bool(known and known.model.version and each and each.begins <= detectors.seq)


def _tracked(command: Command, desired: DesiredState) -> str:
    """The name of the object that a command is for; ObjectError if there is no such object."""
    name, names = object_of(command, desired), desired.objects
    if not names:
        raise ObjectError("no object is tracked yet: give one a box first (set-box), or a saved model (search)")
    if name not in names:
        raise ObjectError(f"there is no object {name!r}: the objects are {listed(names)}")
    return name
