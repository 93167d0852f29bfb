"""The channel `control` of a detector: receives commands, sends the answers, and keeps the desired state on disk."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

from catstream.messages import Answer, Features, Track
from catstream.services.commands import CommandHandler
from catstream.services.desired import DesiredState
from catstream.video.frames import Frame
from catstream.wire.commands import Responder
from catstream.wire.endpoint import Endpoint

__all__ = ["CommandChannel"]

_log = logging.getLogger(__name__)


class CommandChannel(Responder):
    """Connects a `CommandHandler` to its socket and to its file.

    A desired state is on disk before the command that asked for it is answered. A full disk is logged, and stops
    nothing.

    Parameters
    ----------
    file : for the desired state, None if it is not kept
    """

    def __init__(self, endpoint: Endpoint, handler: CommandHandler, file: Path | None) -> None:
        super().__init__(endpoint)
        self._handler, self._file = handler, file
        self._kept: DesiredState | None = None
        self._conclude([])

    def carry_out(self) -> bool:
        """Carry out the commands that have arrived; return whether there were any."""
        commands = self.receive_all()
        self._conclude(self._handler.take(commands))
        return bool(commands)

    def begin(self, frame: Frame) -> tuple[Track, Features] | None:
        """The first track and features, if a command asked to begin with a box in the next frame."""
        found, answers = self._handler.begin(frame)
        self._conclude(answers)
        return found

    def reject_boxes(self, reason: str) -> None:
        """Reject the boxes that wait for a frame."""
        self._conclude(self._handler.reject_boxes(reason))

    def end(self, reason: str) -> None:
        """Reject every command from now on but `save`."""
        self._conclude(self._handler.end(reason))

    def release(self) -> None:
        """Everything is done: a detector that is resumed one day is not stopped."""
        self._handler.release()
        self._conclude([])

    def _conclude(self, answers: Iterable[Answer]) -> None:
        """Keep the desired state if it has changed, then send the answers."""
        if self._file is not None and self._handler.desired != self._kept:
            self._kept = self._handler.desired
            try:
                self._kept.save(self._file)
            except OSError as error:
                _log.warning("what was commanded cannot be kept in %s (%s)", self._file, error.strerror)
        for answer in answers:
            self.answer(answer)
