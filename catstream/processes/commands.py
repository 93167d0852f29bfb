"""Executes control commands between frames, and persists the desired state of a run: objects, paused, stopped."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import replace
from time import monotonic

from catstream.base.files import writing
from catstream.client.saved_model import SavedModel
from catstream.detection.objects import Detectors
from catstream.errors import CatstreamError, ProtocolError, ServiceError
from catstream.processes.control_commands import STOPPED, answer, execute
from catstream.processes.decisions import DesiredObject, DesiredState, Start
from catstream.processes.job import Job
from catstream.processes.model_files import ModelFiles
from catstream.processes.process import Process
from catstream.processes.state import DESIRED, SEARCHED
from catstream.wire.channels import CONTROL
from catstream.wire.commands import Responder
from catstream.wire.messages import Answer, Command

_RETRY_SECONDS = 5.0  # from one attempt to store the desired state to the next


class Commands(AbstractContextManager["Commands"]):
    """The commands of a run, and the state that they have set; a context manager.

    desired  the desired state; `change` stores another one
    models   the saved models that objects begin with
    boxes    the commands `set-box` that wait for a frame
    """

    def __init__(self, process: Process, detectors: Detectors) -> None:
        self._process, self._detectors = process, detectors
        self.models = ModelFiles(process.state / SEARCHED)
        self._file, self._read_problem = process.state / DESIRED, ""
        self.desired = self._first_state(process.job)
        self.boxes: list[Command] = []
        self._responder: Responder[Command, Answer] = Responder(CONTROL, process.endpoint, longest=CONTROL.limit)
        self._stored: DesiredState | None = None  # in the file
        self._tried = 0.0  # when it was last stored, or could not be
        self._paused_until = 0.0  # end of a pause that ends by itself, as its sender may be gone
        # The last message of an earlier detector: its frames are repeated before a command or a pause applies.
        self._repeated = math.inf if process.job.resume else 0.0
        self.store_and_answer()

    def __exit__(self, *_: object) -> None:
        self._responder.close()

    def _first_state(self, job: Job) -> DesiredState:
        """The desired state at the start: the stored one if the run is resumed, otherwise from the job."""
        if job.resume and self._file.exists():
            try:
                desired = DesiredState.load(self._file)
                return replace(desired, paused=desired.paused or job.paused)
            except ProtocolError as error:  # the checkpoints are not affected, so the run continues
                self._read_problem = str(error)
        boxes = {name: DesiredObject(box, begins=1) for name, box in job.boxes.items()}
        saved = {name: self.models.add(SavedModel.load(file)) for name, file in job.models.items()}
        return DesiredState(boxes | saved, paused=job.paused)

    @property
    def apply(self) -> bool:
        """True if commands and pauses apply: the frames of an earlier detector were repeated."""
        return self._detectors.seq >= self._repeated

    @property
    def paused(self) -> bool:
        """True if the run is paused, until a command or for a time."""
        return self.desired.paused or monotonic() < self._paused_until

    @property
    def hold(self) -> bool:
        """True if no frames are tracked because the run is paused, or waits for a box."""
        return self.apply and (self.paused or not self.desired.objects)

    def resume(self, start: Start) -> None:
        """Continue with the objects of a process that died, after the frames that it has to repeat."""
        self._repeated = start.repeats
        self.change(start.desired)

    def change(self, desired: DesiredState) -> None:
        """Set and store the desired state."""
        self.desired = desired
        self.store_and_answer()

    def execute(self) -> bool:
        """Execute the commands that have arrived; returns whether there were any. Boxes wait for a frame."""
        if not self.apply:
            return False
        ending = self._process.ending
        if self.desired.stopped:
            ending.begin(STOPPED)
        if self.desired != self._stored and monotonic() - self._tried >= _RETRY_SECONDS:
            self.store_and_answer()
        commands = self._responder.receive_all()
        for command in commands:
            if ending.reason and command.verb != "save":
                self.reject(command, f"the pipeline is ending: {ending.reason}")
            elif command.verb == "set-box":
                self.boxes.append(command)
            else:
                self.store_and_answer(self._execute(command))
        if ending.reason:
            self.reject_boxes(f"the pipeline is ending: {ending.reason}")
        return bool(commands)

    def _execute(self, command: Command) -> Answer:
        try:
            self.desired, answered = execute(command, self.desired, self._detectors, self._saved_model(command))
        except CatstreamError as error:
            return answer(command, self._detectors, False, str(error))
        for name in self._detectors.detectors.keys() - self.desired.objects.keys():
            self._detectors.forget(name)
        if command.verb == "resume" or (command.verb == "pause" and command.seconds is not None):
            self._paused_until = monotonic() + (command.seconds or 0.0)
        if self.desired.stopped:
            self._process.ending.begin(STOPPED)
        return answered

    def _saved_model(self, command: Command) -> DesiredObject | None:
        """The object that the saved model in a command begins."""
        if command.model is None:
            return None
        self._process.watchdog.allow()
        saved = SavedModel.from_bytes(command.model, "the file")
        saved.check_fits(self._process.settings)
        return self.models.add(saved)

    def take_boxes(self) -> list[Command]:
        """The boxes that wait for a frame; they wait no longer."""
        boxes, self.boxes = self.boxes, []
        return boxes

    def reject(self, command: Command, reason: str) -> None:
        """Answer a command that is not executed."""
        self.store_and_answer(answer(command, self._detectors, False, reason))

    def reject_boxes(self, reason: str) -> None:
        """Reject the boxes that wait for a frame, because there is none."""
        for command in self.take_boxes():
            self.reject(command, reason)

    def store_and_answer(self, *answers: Answer) -> None:
        """Store the desired state if it has changed, then reply; the reply carries the error if saving failed.

        `execute` tries that again after some seconds.
        """
        desired, problem = self.desired, ""
        if desired != self._stored:
            self._tried = monotonic()
            try:
                with writing(self._file):
                    self.models.store()  # before the state that names them
                    desired.save(self._file)
                self._stored = desired
            except ServiceError as error:
                problem = f"{error}; until then, a resumed run does not know the newest commands"
        self._process.trouble = "; ".join(filter(None, (self._read_problem, problem)))
        if desired == self._stored:  # otherwise the file may name a model that is not needed any more
            self.models.keep_only({item.model for item in desired.objects.values()})
        for answered in answers:
            reason = f"{answered.reason}; {problem}" if answered.done and problem else answered.reason
            self._responder.answer(replace(answered, reason=reason))

    def begin_end(self) -> None:
        """No frame follows: the boxes that wait are rejected, and so is every further command except `save`."""
        self._repeated = 0.0
        self.reject_boxes(f"the pipeline is ending: {self._process.ending.reason}")

    def allow_resume(self) -> None:
        """Store that a resumed run does not stop at once, although a command has stopped this one."""
        self.change(replace(self.desired, stopped=False))
