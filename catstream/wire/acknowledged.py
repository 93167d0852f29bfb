"""The acknowledged channel (`all-features`): every message arrives once and in order, whichever side is restarted.

The receiver binds a ROUTER socket, the sender connects a DEALER. The protocol is go-back-N;
`catstream.wire.go_back_n` describes and implements it. Here its two state machines are connected to sockets and to the
clock. A frame without content asks for the position; one of digits also for the states after that message, and the word
`newest` for the newest states.
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
_MOST_RESTARTS = 64  # senders that may wait for an answer at a time; any other asks again


class _Numbered(Protocol):
    @property
    def seq(self) -> int: ...


Message = TypeVar("Message", bound=_Numbered)


class Sender(ChannelSocket[Message]):
    """The sending side of an acknowledged channel; at most `size` messages, fewer large ones, wait for their reply.

    window   the messages that were sent, acknowledged and stored
    replied  called after each reply, with the seq that the receiver has processed and its versions
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
        """Ask once for the position, and the states after message `after`, or the newest ones.

        None if no answer arrived in time.
        """
        self._socket.poll(int(1000 * PATIENCE_SECONDS), zmq.POLLOUT)  # until it is connected
        self._ask(_NEWEST if after is None else b"%d" % after)
        if self._wait(PATIENCE_SECONDS):
            return self._decode(self._socket.recv(), Position)
        return None

    def send(self, message: Message) -> None:
        """Send the message with the next seq, without waiting; ValueError if the window is full.

        ServiceError if the message is larger than the channel takes: it would never arrive.
        """
        self.poll(0)
        data = self._encode(message)
        if len(data) > self.channel.limit:
            raise ServiceError(
                f"a message of {self.channel.name} takes {len(data) >> 20} MiB, more than {self.channel.megabytes}: "
                "track fewer objects, or lower coreset.size"
            )
        self.window.push(message.seq, data)
        self._transmit()

    def poll(self, seconds: float) -> None:
        """Process acknowledgements, waiting at most this long for the first; retransmit missing messages.

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
        with contextlib.suppress(zmq.Again):  # tried again at the next poll
            self.window.transmit(self._send_frame)

    def _ask(self, question: bytes) -> None:
        self.window.asked(monotonic())
        with contextlib.suppress(zmq.Again):  # no receiver is connected yet: it is asked again
            self._socket.send(question, zmq.NOBLOCK)


class Receiver(ChannelSocket[Message]):
    """The receiving side of an acknowledged channel; it binds.

    Each message that `receive` returns is processed, and then acknowledged. Senders that were restarted wait for
    `answer`: what they have not sent themselves should be stored by then, as they cannot repeat it without the source.

    position  where the stream continues; the next message received is the one after `position.processed`
    size      as the sender's
    check     raises ProtocolError if a message does not belong to this stream; it then does not count as received
    states    returns the states of the detectors after a message, or the newest ones, for a sender that was restarted
    window    the messages that were received and stored
    pending_restarts  the senders that were restarted and wait for `answer`, and the message whose states they ask for
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
        self.pending_restarts: dict[bytes, int | None] = {}
        self._size = size
        self._bind()

    def receive(self, seconds: float) -> Message | None:
        """The next message in order, None if none arrived in time."""
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
        if message.seq > self.window.processed + self._size + 1:  # more than a sender may have in flight
            self._reject("sequence", f"message {message.seq} came after {self.window.processed}")
        return message if delivered else None

    def acknowledge(self, position: Position) -> None:
        """Acknowledge all messages; up to `position.seq`, except the last `in_memory` ones, they are stored."""
        self.window.acknowledge(position)
        if self.window.peer is not None:
            self._reply(self.window.peer, self.window.position)

    def answer(self) -> None:
        """Answer the senders that were restarted."""
        for peer, after in self.pending_restarts.items():
            self._reply(peer, replace(self.window.asked(peer), states=self._states(after)))
        self.pending_restarts.clear()

    def close(self) -> None:
        """Close, after the sender if it has sent its end: a connection that breaks may cost it the last reply."""
        if self.window.ended and self.window.connected:
            self._read_events(LINGER_SECONDS, until=Event.DISCONNECTED)
        super().close()

    def _disconnected(self) -> None:
        self.window.disconnected()

    def _reply(self, peer: bytes, position: Position) -> None:
        with contextlib.suppress(zmq.Again):  # a sender that does not read asks again
            self._socket.send_multipart([peer, self._encode(position)], zmq.NOBLOCK)
