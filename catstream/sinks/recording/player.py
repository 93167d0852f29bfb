"""Publishes the messages of a recording on the channels of a pipeline."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from secrets import token_hex
from typing import Self

from catstream.messages.kinds import End, Features, Health, Model, Run, Track
from catstream.sinks.recording.file import Recorded, Recording
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher

_TURN_SECONDS = 0.05  # between two checks for new subscribers
_CHANNEL = {Features: "training", Model: "models", Track: "tracks"}


class Player:
    """Publishes a recording as the pipeline did; a context manager.

    Subscribers receive the same messages as from a running pipeline, but commands are not answered. A slow subscriber
    misses messages, as it does of a pipeline.

    Parameters
    ----------
    recording : to be published
    endpoint : endpoint for the subscribers
    """

    def __init__(self, recording: Recording, endpoint: Endpoint) -> None:
        self._recording = recording
        endpoint = replace(endpoint, run=token_hex(8))  # a page does not mix it with what was here before
        with ExitStack() as stack:
            self._publishers = {
                name: stack.enter_context(Publisher(CHANNELS[name], endpoint, first_message=first_message))
                for name, first_message in (("training", recording.run), ("models", None), ("tracks", None))
            }
            for name in CHANNELS["health"].senders:
                self._publishers[name] = stack.enter_context(Publisher(CHANNELS["health"], endpoint, name))
            self._stack = stack.pop_all()

    def wait(self) -> None:
        """Wait until the tracks have a subscriber."""
        while not self._publishers["tracks"].has_subscribers:
            self._rest(_TURN_SECONDS)

    def play(self, speed: float | None = 1.0) -> Iterator[Recorded]:
        """Send each message, then yield it; the last one is an `End`.

        Parameters
        ----------
        speed : factor to the speed of recording; None for no pauses
        """
        began, first, seq = time.monotonic(), 0.0, 0
        for moment, message in self._recording.messages():
            if isinstance(message, Run | End):
                continue
            first = first or moment
            while speed is not None and (rest := (moment - first) / speed - (time.monotonic() - began)) > 0:
                self._rest(min(rest, _TURN_SECONDS))
            if isinstance(message, Health):
                self._publishers[message.process].send(replace(message, time=time.time()))
            else:
                self._publishers[_CHANNEL[type(message)]].send(message)
            if isinstance(message, Track):
                seq = message.seq
            yield message
        end = self._recording.end or End(seq + 1, "the recording ends here")
        for channel in ("tracks", "training"):
            self._publishers[channel].send(end)
        yield end

    def _rest(self, seconds: float) -> None:
        for publisher in self._publishers.values():
            publisher.serve_late_joiners()
        time.sleep(seconds)

    def close(self) -> None:
        """Send what is still queued, and close the sockets."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
