"""The channel `control` of a detector: receives commands, sends the answers, and keeps the desired state on disk."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from catstream.detection.detector import Result
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import Answer, Command
from catstream.services.commands import CommandHandler
from catstream.services.desired import DesiredState
from catstream.wire.channels import CONTROL
from catstream.wire.commands import Responder
from catstream.wire.endpoint import Endpoint

__all__ = ["CommandChannel"]

_MODEL_SECONDS = 60.0  # limit for reading saved models, and for writing them to a slow disk

_log = logging.getLogger(__name__)


class CommandChannel(Responder[Command, Answer]):
    """Connects a `CommandHandler` to its socket and to its file.

    The desired state and the saved models that it names are written to disk before a command is answered. If the disk
    is full, this is logged, the command is carried out nevertheless, its answer says that it is not kept, and the next
    command tries again.

    Parameters
    ----------
    file : file for the desired state; None if it is not stored
    allow : extends the watchdog's deadline by seconds
    """

    def __init__(
        self, endpoint: Endpoint, handler: CommandHandler, file: Path | None, allow: Callable[[float], None]
    ) -> None:
        super().__init__(CONTROL, endpoint, longest=CONTROL.limit)
        self._allow = allow
        self._handler, self._file = handler, file
        self._kept: DesiredState | None = None  # in the file
        self._tried: DesiredState | None = None  # written last, or not because of an error
        self._conclude([])

    def carry_out(self, *, repeats: bool = False) -> bool:
        """Carry out the commands that have arrived; return whether there were any.

        Parameters
        ----------
        repeats : as for `CommandHandler.carry_out`
        """
        commands = self.receive_all()
        if any(command.model is not None for command in commands):
            self._allow(_MODEL_SECONDS)
        self._conclude(self._handler.carry_out(commands, repeats=repeats))
        return bool(commands)

    def begin(self, frame: Pyramid, time: float) -> dict[str, Result]:
        """Return the results of the objects whose boxes commands have set for this frame, by name."""
        given, answers = self._handler.begin(frame, time)
        self._conclude(answers)
        return given

    def reject_boxes(self, reason: str) -> None:
        """Reject the boxes that wait for a frame."""
        self._conclude(self._handler.reject_boxes(reason))

    def end(self, reason: str) -> None:
        """Mark the end of the stream: from now on, every command except `save` is rejected."""
        self._conclude(self._handler.end(reason))

    def clear_stop(self) -> None:
        """Clear the command `stop` at the end of the run, so that a resumed detector does not stop at once."""
        self._handler.clear_stop()
        self._conclude([])

    def _conclude(self, answers: Iterable[Answer]) -> None:
        """Store the desired state if it has changed, then send the answers."""
        answers, desired = list(answers), self._handler.desired
        if self._file is not None and desired != self._kept and (answers or desired != self._tried):
            self._tried = desired
            try:
                self._handler.models.store()  # before the state that names them
                desired.save(self._file)
                self._kept = desired
                self._handler.models.keep_only(self._handler.needed_models)
            except OSError as error:
                _log.warning("the desired state cannot be written to %s (%s)", self._file, error.strerror)
                lost = f"; a resumed run will not know it, as {self._file} cannot be written ({error.strerror})"
                answers = [replace(each, reason=each.reason + lost) if each.done else each for each in answers]
        for answer in answers:
            self.answer(answer)
