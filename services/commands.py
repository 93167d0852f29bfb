"""Decides the effect of each command on a detector; sends, receives and stores nothing itself.

A command that needs no frame is carried out at once. A box is applied to the next frame that is tracked; during a pause
of a file, to the frame that is held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace

from catstream.box import Box
from catstream.detection.detector import Detector
from catstream.errors import BoxError
from catstream.messages import Answer, Command, Features, Track
from catstream.services.desired import DesiredState
from catstream.video.frames import Frame

__all__ = ["STOPPED", "CommandHandler"]

#: The reason of a stream's end, if a command stopped it.
STOPPED = "it was stopped by a command"


class CommandHandler:
    """Carries out commands and returns their answers: exactly one for each command.

    Parameters
    ----------
    detector : the detector that the commands are for
    desired : the desired state at the start

    Attributes
    ----------
    desired : the desired state now
    end_reason : reason for which no more frames are tracked; empty while frames are tracked
    """

    def __init__(self, detector: Detector, desired: DesiredState) -> None:
        self.desired, self.end_reason = desired, STOPPED if desired.stopped else ""
        self._detector = detector
        self._boxes: deque[tuple[Command, Box]] = deque()  # to be applied to the next frame

    @property
    def has_box(self) -> bool:
        """Whether a box waits for a frame."""
        return bool(self._boxes)

    @property
    def counters(self) -> dict[str, float]:
        """The counters for the health of the process."""
        return {"paused": float(self.desired.paused), "waiting": float(self.desired.box is None)}

    def carry_out(self, commands: Iterable[Command]) -> list[Answer]:
        """Carry out commands; return the answers. The answers to boxes follow from `begin`, with the next frame."""
        answers = []
        for command in commands:
            if self.end_reason and command.verb != "save":
                answers.append(self._answer(command, False, f"the pipeline is ending: {self.end_reason}"))
            elif command.verb == "set-box" and command.box is not None:
                self._boxes.append((command, command.box))
            else:
                answers.append(self._answer(command, *self._apply(command)))
                answers += self.reject_boxes(f"the pipeline is ending: {self.end_reason}") if self.end_reason else []
        return answers

    def begin(self, frame: Frame) -> tuple[tuple[Track, Features] | None, list[Answer]]:
        """Start the detector on a frame, if a command has set a box.

        Returns
        -------
        the first track and features, None if there is no valid box, and the answers
        """
        answers = []
        while self._boxes:
            command, box = self._boxes.popleft()
            keeps = command.keep and self._detector.model.version > 0
            first = self.desired.box is None
            try:
                begin = self._detector.correct if keeps else self._detector.init
                first_result = begin(frame.image, box, frame.time)
            except BoxError as error:
                answers.append(self._answer(command, False, str(error)))
                continue
            if not keeps:
                self.desired = replace(self.desired, box=box, begins=first_result[0].seq)
            what = "the same object continues" if keeps else "the object begins" if first else "another object begins"
            answers.append(self._answer(command, True, f"{what} at {box} in frame {first_result[0].frame}"))
            return first_result, answers
        return None, answers

    def reject_boxes(self, reason: str) -> list[Answer]:
        """Reject the boxes that wait for a frame, because there is none."""
        answers = [self._answer(command, False, reason) for command, _ in self._boxes]
        self._boxes.clear()
        return answers

    def end(self, reason: str) -> list[Answer]:
        """Mark the end of the stream: from now on, every command except `save` is rejected."""
        self.end_reason = reason
        return self.reject_boxes(f"the pipeline is ending: {reason}")

    def clear_stop(self) -> None:
        """Clear the command `stop` at the end of the run, so that a resumed detector does not stop at once."""
        self.desired = replace(self.desired, stopped=False)

    def _apply(self, command: Command) -> tuple[bool, str]:
        """Carry out a command that needs no frame; return whether it was done, and its effect or the error."""
        after = f"after frame {self._detector.seq - 1}" if self._detector.seq else "before the first frame"
        if command.verb == "pause":
            self.desired = replace(self.desired, paused=True)
            return True, f"paused {after}"
        if command.verb == "resume":
            self.desired = replace(self.desired, paused=False)
            return True, "waiting for a box" if self.desired.holds else f"resumed {after}"
        if command.verb == "stop":
            self.desired, self.end_reason = replace(self.desired, stopped=True), STOPPED
            return True, f"the stream ends {after}"
        if not self._detector.model.version or self._detector.box is None:
            return False, "nothing was learned of the object yet: try again once there is a model (catstream status)"
        return True, f"model {self._detector.model.version} {after}"

    def _answer(self, command: Command, done: bool, reason: str) -> Answer:
        detector = self._detector
        frame, version = max(detector.seq - 1, 0), detector.model.version
        return Answer(command.id, done, reason, frame, detector.box, version)
