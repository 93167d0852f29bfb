"""The channel `results`: the tracks of each frame, for the program that owns the run.

A PUSH socket connects to the PULL socket of the owner. Nothing is acknowledged: the owner has started the detector, and
a detector that it starts again goes on after the last frame that the owner has. It drops the frames that it has. The
sender's queue has no limit of its own: a detector is at most `run.unstored_frames` ahead of what its owner has read.
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
    """The owner's side: each frame once, in order; `last` is the number of the last message that the owner has.

    At most `size` messages are queued.
    """

    def __init__(self, endpoint: Endpoint, size: int, last: int) -> None:
        super().__init__(zmq.PULL, RESULTS, endpoint, high_water_mark=size)
        self.last = last
        self._bind()

    def receive(self, seconds: float) -> Tracks | End | None:
        """The next message that is new, None if none arrived in time."""
        if not self._wait(seconds):
            return None
        message = self._decode(self._socket.recv(), *self.channel.messages)
        if message is None or (message.seq <= self.last and isinstance(message, Tracks)):
            return None
        self.last = max(message.seq, self.last)
        return message
