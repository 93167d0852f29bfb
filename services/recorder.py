"""Takes down what a pipeline says: tracks, models and health as they come, and features as they are handed over."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from typing import Any, Self

from catstream.errors import RecordingError
from catstream.messages import End, Health, Model
from catstream.recording.file import RecordingWriter
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Subscriber

__all__ = ["Recorder"]

_log = logging.getLogger(__name__)


class Recorder:
    """Listens to a pipeline, and writes each message once; a context manager.

    Where the disk takes no more, it says so and writes no more: the pipeline goes on.

    Parameters
    ----------
    writer : of the recording; the caller closes it
    endpoint : where the pipeline runs
    reader : name by which its subscription to the tracks was announced, empty if it was not

    Attributes
    ----------
    end : the pipeline's `End`, None before it
    failed : why nothing is written any more; empty while all is well
    """

    def __init__(self, writer: RecordingWriter, endpoint: Endpoint, reader: str = "") -> None:
        self.end: End | None = None
        self.failed = ""
        self._writer = writer
        self._last: dict[str, tuple[float, ...]] = {}  # of the models, and of each process's health
        with ExitStack() as stack:
            known = {"tracks": reader, "models": "", "health": ""}
            self._channels = [
                stack.enter_context(Subscriber(name, endpoint, every=True, reader=reader))
                for name, reader in known.items()
            ]
            self._stack = stack.pop_all()

    def listen(self) -> None:
        """Write what has come."""
        for channel in self._channels:
            for message in channel.waiting():
                if self._new(message):
                    self.keep(message)

    def keep(self, message: Any) -> None:
        """Write a message."""
        if isinstance(message, End):
            self.end = message
        if self.failed:
            return
        try:
            self._writer.write(message)
        except RecordingError as error:
            self.failed = str(error)
            _log.error("%s: the run goes on without", error)

    def _new(self, message: Any) -> bool:
        """Whether it did not come before: a channel's last message is sent again when somebody comes."""
        mark: tuple[float, ...]
        if isinstance(message, Model):
            name, mark = "", (message.version, message.frame)
        elif isinstance(message, Health):
            name, mark = message.process, (message.time,)
        else:
            return True
        known = self._last.get(name)
        self._last[name] = mark
        return mark != known

    def close(self) -> None:
        """Listen no more."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
