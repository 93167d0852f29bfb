"""The channel `results`: the tracks of each frame, for the program that started the run (its owner).

The detector's PUSH socket connects to the owner's PULL socket. Messages are not acknowledged: the owner restarts a dead
detector after the last received frame, and drops repeated frames. The sender's queue is unbounded, because a detector
is at most `run.unstored_frames` ahead of the owner.
"""

from __future__ import annotations

import zmq

from catstream.wire.channels import RESULTS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Tracks
from catstream.wire.socket import ChannelSocket


class ResultsSender(ChannelSocket[Tracks | End]):
    """The detector's side."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(zmq.PUSH, RESULTS, endpoint, high_water_mark=0)
        self._connect()

    def send(self, message: Tracks | End) -> None:
        """Queue a message."""
        self._socket.send(self._encode(message), zmq.NOBLOCK)


class ResultsReceiver(ChannelSocket[Tracks | End]):
    """The owner's side: each frame once, in order, after message number `last`. It queues at most `size` messages."""

    def __init__(self, endpoint: Endpoint, size: int, last: int) -> None:
        super().__init__(zmq.PULL, RESULTS, endpoint, high_water_mark=size)
        self.last = last
        self._bind()

    def receive(self, seconds: float) -> Tracks | End | None:
        """The next new message, None after `seconds` or for a repeat."""
        if not self._wait(seconds):
            return None
        message = self._decode(self._socket.recv(), *self.channel.messages)
        if message is None or (message.seq <= self.last and isinstance(message, Tracks)):
            return None
        self.last = max(message.seq, self.last)
        return message
