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

_RETRY_SECONDS = 5.0  # interval between two attempts to store the desired state


class Commands(AbstractContextManager["Commands"]):
    """The commands of a run, and the desired state that they set; a context manager."""

    def __init__(self, process: Process, detectors: Detectors) -> None:
        self._process, self._detectors = process, detectors
        self.models = ModelFiles(process.state / SEARCHED)  #: saved models of searched objects
        self._file, self._read_problem = process.state / DESIRED, ""
        self.desired = self._initial_state(process.job)  #: the desired state; set it with `change`
        self.boxes: list[Command] = []  #: commands `set-box` that wait for a frame
        self._responder: Responder[Command, Answer] = Responder(CONTROL, process.endpoint, longest=CONTROL.limit)
        self._stored: DesiredState | None = None  # the desired state in the file
        self._tried = 0.0  # time of the last attempt to store it
        self._paused_until = 0.0  # end of a pause with a timeout
        # Last message of an earlier detector: its frames are repeated before commands and pauses apply.
        self._repeated = math.inf if process.job.resume else 0.0
        self.store_and_answer()

    def __exit__(self, *_: object) -> None:
        self._responder.close()

    def _initial_state(self, job: Job) -> DesiredState:
        """The initial desired state: the stored one if the run is resumed, otherwise the job's."""
        if job.resume and self._file.exists():
            try:
                desired = DesiredState.load(self._file)
                return replace(desired, paused=desired.paused or job.paused)
            except ProtocolError as error:  # continue: the checkpoints are intact
                self._read_problem = str(error)
        boxes = {name: DesiredObject(box, begins=1) for name, box in job.boxes.items()}
        saved = {name: self.models.add(SavedModel.load(file)) for name, file in job.models.items()}
        return DesiredState(boxes | saved, paused=job.paused)

    @property
    def apply(self) -> bool:
        """True if commands and pauses apply, because all frames of an earlier detector were repeated."""
        return self._detectors.seq >= self._repeated

    @property
    def paused(self) -> bool:
        """True if the run is paused, until a command or for a time."""
        return self.desired.paused or monotonic() < self._paused_until

    @property
    def suspended(self) -> bool:
        """True if no frames are tracked because the run is paused or waits for a box."""
        return self.apply and (self.paused or not self.desired.objects)

    def resume(self, start: Start) -> None:
        """Continue with the objects of a process that died; commands apply once its frames were repeated."""
        self._repeated = start.repeats
        self.change(start.desired)

    def change(self, desired: DesiredState) -> None:
        """Set and store the desired state."""
        self.desired = desired
        self.store_and_answer()

    def execute(self) -> bool:
        """Execute the received commands; `set-box` waits for a frame. Returns True if there were any."""
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
        """The desired object for the saved model in a command, or None."""
        if command.model is None:
            return None
        self._process.watchdog.allow()
        saved = SavedModel.from_bytes(command.model, "the file")
        saved.check_fits(self._process.settings)
        return self.models.add(saved)

    def take_boxes(self) -> list[Command]:
        """Remove and return the commands that wait for a frame."""
        boxes, self.boxes = self.boxes, []
        return boxes

    def reject(self, command: Command, reason: str) -> None:
        """Answer a command that is not executed."""
        self.store_and_answer(answer(command, self._detectors, False, reason))

    def reject_boxes(self, reason: str) -> None:
        """Reject the commands that wait for a frame."""
        for command in self.take_boxes():
            self.reject(command, reason)

    def store_and_answer(self, *answers: Answer) -> None:
        """Store the desired state if it has changed, then reply. If saving failed, the reply contains the error.

        `execute` retries after some seconds.
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
                problem = f"{error}; until then, a resumed run lacks the newest commands"
        self._process.trouble = "; ".join(filter(None, (self._read_problem, problem)))
        if desired == self._stored:  # otherwise the file may refer to a model that is no longer desired
            self.models.keep_only({item.model for item in desired.objects.values()})
        for answered in answers:
            reason = f"{answered.reason}; {problem}" if answered.done and problem else answered.reason
            self._responder.answer(replace(answered, reason=reason))

    def begin_end(self) -> None:
        """Begin the shutdown: pending boxes are rejected, as are all further commands except `save`."""
        self._repeated = 0.0
        self.reject_boxes(f"the pipeline is ending: {self._process.ending.reason}")

    def allow_resume(self) -> None:
        """Clear the stored command `stop`, so that a resumed run does not stop at once."""
        self.change(replace(self.desired, stopped=False))
