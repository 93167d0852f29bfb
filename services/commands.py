"""The helm: commands to a running detector, heard between frames, and what holds of them.

A command that needs no frame is carried out and answered at once; a box waits for the next frame in hand. What
holds on is kept in a file, so that a detector that dies and is restarted goes on as it was told.
"""

from __future__ import annotations

import json
import logging
from collections import deque
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

from catstream import storage
from catstream.box import Box
from catstream.detection.detector import Detector
from catstream.errors import BoxError, ProtocolError
from catstream.messages import Answer, Command, Features, Track
from catstream.video.frames import Frame
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Responder

__all__ = ["STOPPED", "CommandHandler", "DesiredState"]

#: Why a stream ended that a command stopped.
STOPPED = "it was stopped by a command"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DesiredState:
    """What holds until something else is ordered.

    box      the object in its first frame; of a saved model about its size; None while a box is waited for
    begins   seq of the message with that first frame, 0 where the object is to be found by a saved model
    paused   whether no frame is followed
    stopped  whether the stream ends as it is
    """

    box: Box | None = None
    begins: int = 0
    paused: bool = False
    stopped: bool = False

    def save(self, path: Path) -> None:
        """Write them, whole or not at all."""
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        storage.write_atomically(path, json.dumps(asdict(self)).encode())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        ProtocolError
            Where it cannot be read.
        """
        try:
            told = json.loads(path.read_text())
            return cls(**{**told, "box": told["box"] and Box(*told["box"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ProtocolError(
                f"what was commanded cannot be read from {path} ({error!r}): what the run was started with holds, "
                "command the rest again"
            ) from None


class CommandHandler:
    """Hears commands, carries them out and answers them.

    Parameters
    ----------
    detector : the one that is steered
    desired : what holds at the start
    file : where that is kept as it changes, None for nowhere

    Attributes
    ----------
    desired : what holds now
    over : why no frame will be followed any more, empty before
    """

    def __init__(self, endpoint: Endpoint, detector: Detector, desired: DesiredState, file: Path | None) -> None:
        self.desired, self.over = desired, STOPPED if desired.stopped else ""
        self._detector, self._file = detector, file
        self._boxes: deque[tuple[Command, Box]] = deque()  # that wait for a frame
        self._commands = Responder("control", endpoint)
        self._hold(desired)

    @property
    def holds(self) -> bool:
        """Whether frames are not followed now."""
        return self.desired.paused or self.desired.box is None

    @property
    def counters(self) -> dict[str, float]:
        """What health tells of it."""
        return {"paused": float(self.desired.paused), "waiting": float(self.desired.box is None)}

    @property
    def wanted(self) -> bool:
        """Whether a box waits for a frame."""
        return bool(self._boxes)

    def listen(self) -> bool:
        """Take in what was commanded; returns whether anything was."""
        commands = self._commands.waiting()
        for command in commands:
            if self.over and command.verb != "save":
                self._answer(command, False, f"it ends: {self.over}")
            elif command.verb == "set-box" and command.box is not None:
                self._boxes.append((command, command.box))
            else:
                self._answer(command, *self._done(command))
        return bool(commands)

    def follow(self, frame: Frame) -> tuple[Track, Features] | None:
        """What a frame gives where a box for it was commanded, else None; one box a frame."""
        while self._boxes:
            command, box = self._boxes.popleft()
            keeps = command.keep and self._detector.model.version > 0
            first = self.desired.box is None
            try:
                place = self._detector.correct if keeps else self._detector.init
                found = place(frame.image, box, frame.time)
            except BoxError as error:
                self._answer(command, False, str(error))
                continue
            if not keeps:
                self._hold(replace(self.desired, box=box, begins=found[0].seq))
            what = "the same object goes on" if keeps else "the object begins" if first else "another object begins"
            self._answer(command, True, f"{what} at {box} in frame {found[0].frame}")
            return found
        return None

    def refuse_boxes(self, reason: str) -> None:
        """Answer the boxes that wait: there is no frame for them."""
        while self._boxes:
            self._answer(self._boxes.popleft()[0], False, reason)

    def end(self, reason: str) -> None:
        """No frame follows: all is refused but to save what was learned."""
        self.over = reason
        self.refuse_boxes(f"it ends: {reason}")

    def release(self) -> None:
        """All is done: a detector that goes on from here one day is not stopped."""
        self._hold(replace(self.desired, stopped=False))

    def close(self) -> None:
        """Hear no more."""
        self._commands.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _done(self, command: Command) -> tuple[bool, str]:
        """Carry out what needs no frame; whether it was, and what or why not."""
        after = f"after frame {self._detector.seq - 1}" if self._detector.seq else "before the first frame"
        if command.verb == "pause":
            self._hold(replace(self.desired, paused=True))
            return True, f"paused {after}"
        if command.verb == "resume":
            self._hold(replace(self.desired, paused=False))
            return True, "it waits for a box" if self.holds else f"it goes on {after}"
        if command.verb == "stop":
            self._hold(replace(self.desired, stopped=True))
            self.end(STOPPED)
            return True, f"the stream ends {after}"
        if not self._detector.model.version or self._detector.box is None:
            return False, "nothing was learned of the object yet: ask again once there is a model (catstream status)"
        return True, f"model {self._detector.model.version} {after}"

    def _hold(self, desired: DesiredState) -> None:
        self.desired = desired
        if self._file is not None:
            try:
                desired.save(self._file)
            except OSError as error:  # a full disk stops nothing
                _log.warning("what was commanded cannot be kept in %s (%s)", self._file, error.strerror)

    def _answer(self, command: Command, done: bool, reason: str) -> None:
        detector = self._detector
        frame, version = max(detector.seq - 1, 0), detector.model.version
        self._commands.answer(Answer(command.id, done, reason, frame, detector.box, version))
