"""Decides the effect of each command on a detector; sends, receives and stores nothing itself.

A command that needs no frame is carried out at once. A box is applied to the next frame that is tracked; during a pause
of a file, to the frame that is held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace

from catstream.detection.detector import Result
from catstream.detection.objects import Detectors
from catstream.errors import BoxError, CatstreamError, ObjectError
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import Answer, Command
from catstream.messages.names import UNNAMED, check_count, check_name, listed
from catstream.run.learned import Learned, check_sizes
from catstream.services.desired import DesiredState
from catstream.services.model_files import ModelFiles

__all__ = ["STOPPED", "CommandHandler"]

#: The reason of a stream's end, if a command stopped it.
STOPPED = "it was stopped by a command"

#: Commands whose effect does not depend on the frame at which they arrive.
_AT_ANY_FRAME = ("pause", "resume", "stop")


class CommandHandler:
    """Carries out commands and returns their answers: exactly one for each command.

    Parameters
    ----------
    detectors : the detectors that the commands are for
    desired : the desired state at the start
    models : the saved models that it names

    Attributes
    ----------
    desired : the desired state now
    models : the saved models that it names
    end_reason : reason for which no more frames are tracked; empty while frames are tracked
    """

    def __init__(self, detectors: Detectors, desired: DesiredState, models: ModelFiles) -> None:
        self.desired, self.end_reason = desired, STOPPED if desired.stopped else ""
        self.models, self._detectors = models, detectors
        self._boxes: deque[Command] = deque()  # to be applied to the next frame
        self._waiting: list[Command] = []  # that arrived while frames are repeated

    @property
    def has_box(self) -> bool:
        """Whether a box waits for a frame."""
        return bool(self._boxes)

    @property
    def needed_models(self) -> set[str]:
        """The names of the saved models that a restarted detector may need for the frames that it repeats, or later."""
        return self.desired.models_since(self._detectors.seq - self._detectors.settings.run.unstored_frames)

    @property
    def counters(self) -> dict[str, float]:
        """The counters for the health of the process."""
        return {"paused": float(self.desired.paused), "waiting": float(not self.desired.objects)}

    def carry_out(self, commands: Iterable[Command], *, repeats: bool = False) -> list[Answer]:
        """Carry out commands; return the answers. The answers to boxes follow from `begin`, with the next frame.

        Parameters
        ----------
        repeats : whether an earlier detector has sent the next message already: commands for objects then wait until
            this ends, because their objects begin or end with a message that nobody has received yet
        """
        answers = []
        arrived, self._waiting = [*self._waiting, *commands], []
        for command in arrived:
            if repeats and not self.end_reason and command.verb not in _AT_ANY_FRAME:
                self._waiting.append(command)
            elif self.end_reason and command.verb != "save":
                answers.append(self._answer(command, False, f"the pipeline is ending: {self.end_reason}"))
            elif command.verb == "set-box":
                self._boxes.append(command)
            else:
                answers.append(self._carried_out(command))
                answers += self.reject_boxes(f"the pipeline is ending: {self.end_reason}") if self.end_reason else []
        return answers

    def begin(self, frame: Pyramid, time: float) -> tuple[dict[str, Result], list[Answer]]:
        """Start the detectors of the objects whose boxes commands have set, in the next frame.

        Of two boxes for one name, the second one waits for the frame after it.

        Returns
        -------
        the result of each object whose box is valid, by name, and the answers
        """
        given: dict[str, Result] = {}
        answers = []
        later: deque[Command] = deque()
        while self._boxes:
            command = self._boxes.popleft()
            try:
                name = self._name(command)
                if name in given:
                    later.append(command)
                    continue
                given[name], effect = self._begun(name, command, frame, time)
                answers.append(self._answer(command, True, effect, name, self._detectors.seq))
            except (BoxError, ObjectError) as error:
                answers.append(self._answer(command, False, str(error)))
        self._boxes = later
        return given, answers

    def _begun(self, name: str, command: Command, frame: Pyramid, time: float) -> tuple[Result, str]:
        """The result of an object at the box of a command, and the effect."""
        detectors, box = self._detectors, command.box
        if box is None:
            raise BoxError("no box was given")
        at, of_name = f"at {box} in frame {detectors.seq}", f" {name}" if name else ""
        if command.keep and self._has_model(name):
            return detectors.correct(name, frame, box, time), f"the same object{of_name} continues {at}"
        if name not in self.desired.objects:
            check_count(len(self.desired.objects) + 1, detectors.settings.run.objects_most)
        result = detectors.begin(name, frame, box, time)
        article = "another" if name in self.desired.objects else "the"
        self.desired = self.desired.begun(name, box, result[0].seq)
        return result, f"{article} object{of_name} begins {at}"

    def _has_model(self, name: str) -> bool:
        """Whether a model was trained of an object; another one, which begins with the next frame, has none yet."""
        known, begun = self._detectors.detectors.get(name), self.desired.objects_at(self._detectors.seq)
        return known is not None and known.model.version > 0 and self.desired.objects.get(name) is begun.get(name)

    def reject_boxes(self, reason: str) -> list[Answer]:
        """Reject the boxes that wait for a frame, because there is none."""
        answers = [self._answer(command, False, reason) for command in self._boxes]
        self._boxes.clear()
        return answers

    def end(self, reason: str) -> list[Answer]:
        """Mark the end of the stream: from now on, every command except `save` is rejected."""
        self.end_reason = reason
        return [*self.reject_boxes(f"the pipeline is ending: {reason}"), *self.carry_out([])]

    def clear_stop(self) -> None:
        """Clear the command `stop` at the end of the run, so that a resumed detector does not stop at once."""
        self.desired = replace(self.desired, stopped=False)

    def _carried_out(self, command: Command) -> Answer:
        """Carry out a command that needs no frame; return its answer."""
        seq = self._detectors.seq
        after = f"after frame {seq - 1}" if seq else "before the first frame"
        match command.verb:
            case "pause":
                self.desired = replace(self.desired, paused=True)
                return self._answer(command, True, f"paused {after}")
            case "resume":
                self.desired = replace(self.desired, paused=False)
                return self._answer(command, True, "waiting for a box" if self.desired.holds else f"resumed {after}")
            case "stop":
                self.desired, self.end_reason = replace(self.desired, stopped=True), STOPPED
                return self._answer(command, True, f"the stream ends {after}")
            case "search":
                return self._search(command)
        try:
            name = self._name(command)
            if not self.desired.objects:
                raise ObjectError("no object is tracked yet: give one a box first (set-box), or a saved model (search)")
            if name not in self.desired.objects:
                raise ObjectError(f"there is no object {name!r}: the objects are {listed(self.desired.objects)}")
        except ObjectError as error:
            return self._answer(command, False, str(error))
        return self._forget(command, name, after) if command.verb == "forget" else self._save(command, name, after)

    def _search(self, command: Command) -> Answer:
        """Begin an object in the next frame: it is searched for by a saved model."""
        settings, seq = self._detectors.settings, self._detectors.seq
        try:
            name = self._name(command)
            if name not in self.desired.objects:
                check_count(len(self.desired.objects) + 1, settings.run.objects_most)
            learned = Learned.from_bytes(command.model or b"", "the file")
            learned.check_fits(settings)
            new = self.desired.begun(name, learned.box, seq + 1, self.models.add(learned))
            begins = {name: each.model for name, each in new.objects.items() if each.begins > seq}
            check_sizes({name: self.models.size(model) for name, model in begins.items()})
        except CatstreamError as error:
            return self._answer(command, False, str(error))
        self.desired = new
        reason = f"{listed([name])} is searched for from frame {seq} on, by model {learned.model.version}"
        return self._answer(command, True, reason, name)

    def _forget(self, command: Command, name: str, after: str) -> Answer:
        """Stop tracking an object; everything learned of it is dropped."""
        self.desired = self.desired.without(name, self._detectors.seq)
        self._detectors.detectors.pop(name, None)
        waits = "" if self.desired.objects else ": no object is left, so the run waits for a box"
        return self._answer(command, True, f"{listed([name])} is no longer tracked {after}{waits}", name)

    def _save(self, command: Command, name: str, after: str) -> Answer:
        """The answer with the version of the model; the client writes the file."""
        detector = self._detectors.detectors.get(name)
        if detector is None or not detector.model.version or detector.state is None:
            why = "nothing was learned of the object yet: try again once there is a model (catstream status)"
            return self._answer(command, False, why, name)
        if detector.state.first_window is None:
            why = "the object of the saved model was not found yet: try again once it was"
            return self._answer(command, False, why, name)
        return self._answer(command, True, f"model {detector.model.version} {after}", name)

    def _name(self, command: Command) -> str:
        """The name of the object that a command is for: without a name, the object that has none, or the only one."""
        names = self.desired.objects
        if command.object or not names or UNNAMED in names:
            return check_name(command.object)
        if len(names) > 1:
            raise ObjectError(f"which object? This run has {listed(names)}: give a name")
        return next(iter(names))

    def _answer(
        self, command: Command, done: bool, reason: str, name: str | None = None, frame: int | None = None
    ) -> Answer:
        """The answer to a command for the object `name`, by default that of the command."""
        name = command.object if name is None else name
        detector = self._detectors.detectors.get(name)
        frame = max(self._detectors.seq - 1, 0) if frame is None else frame
        box, version = (detector.box, detector.model.version) if detector is not None else (None, 0)
        return Answer(command.id, done, reason, frame, box, version, name)
