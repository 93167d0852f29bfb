"""The acknowledged channel (`all-features`): every message arrives once and in order, even if a side is restarted.

The receiver binds a ROUTER socket, the sender connects a DEALER. The protocol is go-back-N; `catstream.wire.go_back_n`
describes and implements it. This module connects its two state machines to sockets and to the clock. An empty frame
requests the position; the digits of a `seq` also request the states after that message, and `newest` the newest states.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import monotonic
from typing import Protocol, TypeVar

import zmq

from catstream.errors import ServiceError
from catstream.wire.channels import Channel
from catstream.wire.endpoint import Endpoint
from catstream.wire.go_back_n import PATIENCE_SECONDS, ReceiveWindow, SendWindow
from catstream.wire.messages import DetectorState, End, Position
from catstream.wire.monitor import Event
from catstream.wire.socket import LINGER_SECONDS, ChannelSocket

_LONGEST_QUESTION = 20  # bytes
_NEWEST = b"newest"
_MOST_RESTARTS = 64  # restarted senders that may wait for an answer; others repeat their question


class _Numbered(Protocol):
    @property
    def seq(self) -> int: ...


Message = TypeVar("Message", bound=_Numbered)


class Sender(ChannelSocket[Message]):
    """The sending side of an acknowledged channel, with at most `size` unacknowledged messages (fewer large ones).

    window   counts of sent, acknowledged and stored messages
    replied  called after each reply, with the newest processed seq and the versions of the samples
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        size: int,
        replied: Callable[[int, dict[str, int]], object] = lambda *_: None,
    ) -> None:
        super().__init__(zmq.DEALER, channel, endpoint, high_water_mark=size + 1)
        self.window, self._replied = SendWindow(channel.name, size, monotonic()), replied
        self._send_frame = partial(self._socket.send, flags=zmq.NOBLOCK, copy=False)
        self._socket.set(zmq.IMMEDIATE, 1)  # nothing is queued before the receiver is connected
        self._connect()

    def ask_position(self, after: int | None) -> Position | None:
        """Request the position, and the states after message `after` or the newest states; None on a timeout."""
        self._socket.poll(int(1000 * PATIENCE_SECONDS), zmq.POLLOUT)  # until it is connected
        self._ask(_NEWEST if after is None else b"%d" % after)
        if self._wait(PATIENCE_SECONDS):
            return self._decode(self._socket.recv(), Position)
        return None

    def send(self, message: Message) -> None:
        """Send the message with the next seq, without waiting.

        ValueError if the window is full, ServiceError if the message exceeds the channel's limit.
        """
        self.poll(0)
        data = self._encode(message)
        if len(data) > self.channel.limit:
            raise ServiceError(
                f"a message of {self.channel.name} has {len(data) >> 20} MiB, more than {self.channel.megabytes}: "
                "track fewer objects, or lower coreset.size"
            )
        self.window.push(message.seq, data)
        self._transmit()

    def poll(self, seconds: float) -> None:
        """Process acknowledgements, waiting up to `seconds` for the first; retransmit missing messages.

        Raises the errors of `SendWindow.receive`.
        """
        while self._wait(seconds):
            position = self._decode(self._socket.recv(), Position)
            if position is not None and self.window.receive(position, monotonic()):
                self._replied(self.window.processed, dict(position.versions))
            seconds = 0.0
        if self.window.must_ask(monotonic()):
            self._ask(b"")
        self._transmit()

    def _disconnected(self) -> None:
        self.window.disconnected()

    def _transmit(self) -> None:
        with contextlib.suppress(zmq.Again):  # `poll` retries
            self.window.transmit(self._send_frame)

    def _ask(self, question: bytes) -> None:
        self.window.asked(monotonic())
        with contextlib.suppress(zmq.Again):  # not connected yet: the request is repeated
            self._socket.send(question, zmq.NOBLOCK)


class Receiver(ChannelSocket[Message]):
    """The receiving side of an acknowledged channel; it binds.

    The application processes each message of `receive`, then acknowledges it. Restarted senders wait for `answer`. The
    application should store all messages before, because senders cannot repeat them without the source.

    position  position of the stream: the next message is the one after `position.processed`
    size      size of the sender's window
    check     raises ProtocolError if a message belongs to another stream; the message is dropped
    states    returns the states of the detectors after a message, or the newest ones, for a restarted sender
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        position: Position,
        size: int,
        check: Callable[[Message], None] | None = None,
        states: Callable[[int | None], dict[str, DetectorState]] = lambda _: {},
    ) -> None:
        super().__init__(zmq.ROUTER, channel, endpoint, high_water_mark=size + 1)
        self.window, self._check, self._states = ReceiveWindow(position, size), check, states
        #: Restarted senders that wait for `answer`, each with the message whose states it requests (None: the newest).
        self.pending_restarts: dict[bytes, int | None] = {}
        self._size = size
        self._bind()

    def receive(self, seconds: float) -> Message | None:
        """The next message in order, None after `seconds` or for any other frame."""
        if not self._wait(seconds):
            return None
        peer, data = self._receive_from_peer()
        if data is None:
            return None
        if not data:
            self._reply(peer, self.window.asked(peer))
            return None
        if len(data) <= _LONGEST_QUESTION and ((question := bytes(data)).isdigit() or question == _NEWEST):
            if len(self.pending_restarts) < _MOST_RESTARTS:
                self.pending_restarts[peer] = None if question == _NEWEST else int(question)
            return None
        message = self._decode(data, *self.channel.messages, check=self._check)
        if message is None:
            return None
        last = isinstance(message, End)
        delivered, reply = self.window.receive(peer, message.seq, monotonic(), last=last, size=len(data))
        if reply is not None:
            self._reply(peer, reply)
        if message.seq > self.window.processed + self._size + 1:  # outside of the sender's window
            self._reject("sequence", f"message {message.seq} came after {self.window.processed}")
        return message if delivered else None

    def acknowledge(self, position: Position) -> None:
        """Acknowledge all messages; those up to `position.seq` are stored, except the last `in_memory` ones."""
        self.window.acknowledge(position)
        if self.window.peer is not None:
            self._reply(self.window.peer, self.window.position)

    def answer(self) -> None:
        """Answer all restarted senders."""
        for peer, after in self.pending_restarts.items():
            self._reply(peer, replace(self.window.asked(peer), states=self._states(after)))
        self.pending_restarts.clear()

    def close(self) -> None:
        """Close; after the end of the stream, wait until the sender has closed, so that it receives the last reply."""
        if self.window.ended and self.window.connected:
            self._read_events(LINGER_SECONDS, until=Event.DISCONNECTED)
        super().close()

    def _disconnected(self) -> None:
        self.window.disconnected()

    def _reply(self, peer: bytes, position: Position) -> None:
        with contextlib.suppress(zmq.Again):  # the queue is full: the sender repeats its request
            self._socket.send_multipart([peer, self._encode(position)], zmq.NOBLOCK)
