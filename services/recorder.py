"""Records a pipeline: subscribes to tracks, models and health; the caller adds the features."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Self

from catstream.errors import RecordingError
from catstream.messages.kinds import End, Health, Model, Track
from catstream.sinks.recording.file import Recorded, RecordingWriter
from catstream.wire.channels import HEALTH, MODELS, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber


class Recorder:
    """Subscribes to a pipeline and writes each message once; a context manager.

    If the disk is full, only the `End` is written from then on, by which a reader knows how many messages are missing.

    Parameters
    ----------
    writer : writer of the recording; the caller closes it
    endpoint : endpoint of the pipeline
    tracks : subscriber to the tracks, if there is one already

    Attributes
    ----------
    end : the pipeline's `End`, None before it was received
    failed : error that has ended the writing; empty if there was none
    """

    def __init__(
        self, writer: RecordingWriter, endpoint: Endpoint, tracks: Subscriber[Track | End] | None = None
    ) -> None:
        self.end: End | None = None
        self.failed = ""
        self._writer = writer
        with ExitStack() as stack:
            self._subscribers: list[Subscriber[Track | End] | Subscriber[Model] | Subscriber[Health]] = [
                stack.enter_context(tracks or Subscriber(TRACKS, endpoint)),
                stack.enter_context(Subscriber(MODELS, endpoint)),
                stack.enter_context(Subscriber(HEALTH, endpoint)),
            ]
            self._stack = stack.pop_all()

    @property
    def written(self) -> int:
        """Number of messages that were written."""
        return self._writer.written

    def receive(self) -> None:
        """Write the messages that were received."""
        for subscriber in self._subscribers:
            for message in subscriber.receive_all():
                self.write(message)

    def write(self, message: Recorded) -> None:
        """Write a message."""
        if isinstance(message, End):
            self.end = message
        elif self.failed:
            return
        try:
            self._writer.write(message)
        except RecordingError as error:
            self.failed = str(error)

    def close(self) -> None:
        """Close the subscriptions."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
