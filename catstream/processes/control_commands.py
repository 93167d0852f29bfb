"""The effects of commands, and their answers: pure functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from catstream.base.names import UNNAMED, check_count, check_name
from catstream.base.text import listed
from catstream.client.saved_model import check_sizes
from catstream.detection.objects import Detectors
from catstream.errors import ObjectError
from catstream.processes.decisions import DesiredObject, DesiredState
from catstream.wire.messages import Answer, Command

#: Reason of the end of a stream that a command stopped.
STOPPED = "it was stopped by a command"

#: The desired state after a command, and the answer to it.
Outcome = tuple[DesiredState, Answer]


def execute(
    command: Command, desired: DesiredState, detectors: Detectors, model: DesiredObject | None = None
) -> Outcome:
    """The desired state and the answer for a command that needs no frame; `model` is the desired object of `search`.

    ObjectError or SettingsError if it cannot be executed. The `detectors` are not changed.
    """
    return _VERBS[command.verb](_Execution(command, desired, detectors, model))


@dataclass(frozen=True, slots=True, eq=False)
class _Execution:
    """The arguments of `execute`, with a method for each verb."""

    command: Command
    desired: DesiredState
    detectors: Detectors
    model: DesiredObject | None

    def pause(self) -> Outcome:
        seconds = self.command.seconds
        if self.desired.paused or seconds is None:
            return self._done(replace(self.desired, paused=True), f"paused {self._moment}")
        if seconds > 0:  # a pause with a timeout is not stored
            return self._done(self.desired, f"paused for {seconds:g} s {self._moment}")
        return self.resume()

    def resume(self) -> Outcome:
        effect = f"resumed {self._moment}" if self.desired.objects else "waiting for a box"
        return self._done(replace(self.desired, paused=False), effect)

    def stop(self) -> Outcome:
        return self._done(replace(self.desired, stopped=True), f"the stream ends {self._moment}")

    def search(self) -> Outcome:
        name, seq = object_of(self.command, self.desired), self.detectors.seq
        check_room(name, self.desired, self.detectors.settings.run.max_objects)
        if self.model is None:
            raise ObjectError("missing saved model: search needs the file of one")
        desired = self.desired.with_object(name, replace(self.model, begins=seq + 1))
        check_sizes({name: item.size for name, item in desired.objects.items() if item.begins > seq and item.model})
        effect = f"{listed([name])} is searched for from frame {seq} on, by model {self.model.version}"
        return self._done(desired, effect, name)

    def forget(self) -> Outcome:
        name = _tracked(self.command, self.desired)
        desired = self.desired.without(name)
        waits = "" if desired.objects else ": no object is left, so the run waits for a box"
        effect = f"{listed([name])} is no longer tracked {self._moment}{waits}"
        _, answered = self._done(desired, effect, name)
        return desired, replace(answered, box=None, version=0)

    def save(self) -> Outcome:
        """Check that there is a model; the client writes the file."""
        name = _tracked(self.command, self.desired)
        detector = self.detectors.detectors.get(name)
        if detector is None or detector.state is None or not detector.model.version:
            problem = "the object has no model yet: try again later (catstream status shows the version)"
        elif detector.state.is_searched:
            problem = "the object of the saved model was not detected yet: try again once it was"
        else:
            return self._done(self.desired, f"model {detector.model.version} {self._moment}", name)
        return self.desired, answer(self.command, self.detectors, False, problem, name)

    def _done(self, desired: DesiredState, effect: str, name: str | None = None) -> Outcome:
        return desired, answer(self.command, self.detectors, True, effect, name)

    @property
    def _moment(self) -> str:
        """Description of the time of execution."""
        return f"after frame {self.detectors.seq - 1}" if self.detectors.seq else "before the first frame"


_VERBS: dict[str, Callable[[_Execution], Outcome]] = {
    "pause": _Execution.pause,
    "resume": _Execution.resume,
    "stop": _Execution.stop,
    "search": _Execution.search,
    "forget": _Execution.forget,
    "save": _Execution.save,
}


def answer(
    command: Command, detectors: Detectors, done: bool, reason: str, name: str | None = None, frame: int | None = None
) -> Answer:
    """The answer to a command for the object `name`, by default the object of the command."""
    name = command.object if name is None else name
    frame = max(detectors.seq - 1, 0) if frame is None else frame
    detector = detectors.detectors.get(name)
    box, version = (detector.box, detector.model.version) if detector is not None else (None, 0)
    return Answer(command.id, done, reason, frame, box, version, name)


def object_of(command: Command, desired: DesiredState) -> str:
    """The name of the object of a command; by default the unnamed object, or the only one."""
    names = desired.objects
    if command.object or not names or UNNAMED in names:
        return check_name(command.object)
    if len(names) > 1:
        option = " (--object NAME)" if command.verb == "save" else ""
        raise ObjectError(f"ambiguous object: this run tracks {listed(names)}; pass a name{option}")
    return next(iter(names))


def check_room(name: str, desired: DesiredState, most: int) -> None:
    """Raise ObjectError if a new object of this name would exceed the limit `most`."""
    if name not in desired.objects:
        check_count(len(desired.objects) + 1, most)


def continues(command: Command, name: str, desired: DesiredState, detectors: Detectors) -> bool:
    """Return True if a box continues the same object; an object without a model begins again."""
    detector, current = detectors.detectors.get(name), desired.objects.get(name)
    return command.keep and bool(detector and detector.model.version and current and current.begins <= detectors.seq)


def _tracked(command: Command, desired: DesiredState) -> str:
    """The name of the tracked object of a command; ObjectError if there is no such object."""
    name, names = object_of(command, desired), desired.objects
    if not names:
        raise ObjectError("no object is tracked yet: set the box of one (set-box), or search for a saved model")
    if name not in names:
        raise ObjectError(f"there is no object {name!r}: this run tracks {listed(names)}")
    return name
