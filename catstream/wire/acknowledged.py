"""Acknowledged channels (`features`, `results`): every message arrives once and in order, whichever side is restarted.

The receiver binds a ROUTER socket, the sender connects a DEALER. The protocol is go-back-N;
`catstream.wire.go_back_n` describes and implements it. Here its two state machines are connected to sockets and to the
clock.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic
from typing import Protocol, TypeVar

import zmq

from catstream.errors import ServiceError
from catstream.messages.kinds import End, Position, Stored
from catstream.wire.channels import Channel
from catstream.wire.endpoint import Endpoint
from catstream.wire.go_back_n import HELLO, PATIENCE_SECONDS, Deliver, ReceiveWindow, Reject, Reply, SendWindow
from catstream.wire.socket import LINGER_SECONDS, ChannelSocket, Event

_REPLIES: tuple[type[Stored | Position], ...] = (Stored, Position)


class _Numbered(Protocol):
    @property
    def seq(self) -> int: ...


Message = TypeVar("Message", bound=_Numbered)


class Sender(ChannelSocket[Message]):
    """The sending side of an acknowledged channel.

    Parameters
    ----------
    window : messages that may be sent and not acknowledged; fewer if they are large

    Attributes
    ----------
    window : the messages that were sent, acknowledged and stored
    """

    def __init__(self, channel: Channel[Message], endpoint: Endpoint, window: int) -> None:
        super().__init__(zmq.DEALER, channel, endpoint, high_water_mark=window + 1)
        self.window = SendWindow(channel.name, window, monotonic())
        self._send_frame = partial(self._socket.send, flags=zmq.NOBLOCK, copy=False)
        self._socket.set(zmq.IMMEDIATE, 1)  # nothing is queued before the receiver is connected
        self._connect()

    def ask_position(self) -> Position | None:
        """Ask once for the receiver's position; None if it does not answer in time."""
        self._say_hello()
        if self._wait(PATIENCE_SECONDS):
            answer = self._decode(self._socket.recv(), *_REPLIES)
            return answer if isinstance(answer, Position) else None
        return None

    def send(self, message: Message) -> None:
        """Send the message with the next seq, without waiting.

        Raises
        ------
        ValueError
            If the window is full.
        ServiceError
            If the message is larger than the channel takes: it would never arrive.
        """
        self.poll(0)
        data = self._encode(message)
        if len(data) > self.channel.limit:
            raise ServiceError(
                f"a message of {self.channel.name} takes {len(data) >> 20} MiB, more than {self.channel.megabytes}: "
                "follow fewer objects, or give a smaller coreset.size"
            )
        self.window.push(message.seq, data)
        self._transmit()

    def poll(self, seconds: float) -> None:
        """Process acknowledgements, waiting at most this long for the first; retransmit what is missing.

        Raises
        ------
        ProtocolError
            If the receiver holds another stream.
        StreamRewoundError
            If the receiver has lost messages that it had acknowledged.
        """
        while self._wait(seconds):
            self._process(self._socket.recv())
            seconds = 0.0
        if self.window.must_ask(monotonic()):
            self._say_hello()
        self._transmit()

    def _disconnected(self) -> None:
        super()._disconnected()
        self.window.disconnected()

    def _process(self, data: bytes) -> None:
        answer = self._decode(data, *_REPLIES)
        if answer is not None and (rejected := self.window.receive(answer, monotonic())) is not None:
            self._reject(rejected.reason, rejected.text)

    def _transmit(self) -> None:
        with contextlib.suppress(zmq.Again):  # tried again at the next poll
            self.window.transmit(self._send_frame)

    def _say_hello(self) -> None:
        self.window.position_requested(monotonic())
        with contextlib.suppress(zmq.Again):  # no receiver is connected yet: it is asked again
            self._socket.send(HELLO, zmq.NOBLOCK)


class Receiver(ChannelSocket[Message]):
    """The receiving side of an acknowledged channel; it binds.

    Receiving stores nothing. If a new sender asks for the position while more was received than is stored,
    `window.position_requested` becomes true; the owner then stores what it has, and calls `answer`. In a loop:

        message = receiver.receive(0.1)
        ...                                     # process the message
        if receiver.window.position_requested:
            receiver.answer(store())
        elif message is not None:
            receiver.acknowledge(position)

    Parameters
    ----------
    position : where the stream continues; the next message received is the one after `position.seq`
    window : as the sender's
    check : raises ProtocolError if a message does not belong to this stream; it then does not count as received

    Attributes
    ----------
    window : the messages that were received and stored
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        position: Position,
        window: int,
        check: Callable[[Message], None] | None = None,
    ) -> None:
        super().__init__(zmq.ROUTER, channel, endpoint, high_water_mark=window + 1)
        self.window, self._check = ReceiveWindow(position, window), check
        self._bind()

    def receive(self, seconds: float) -> Message | None:
        """The next message in order, None if none arrived in time."""
        if not self._wait(seconds):
            return None
        peer, data = self._receive_from_peer()
        if data is None:
            return None
        if not data:
            self._reply(self.window.hello(peer))
            return None
        message = self._decode(data, *self.channel.messages, check=self._check)
        if message is None:
            return None
        ends = isinstance(message, End)
        actions = self.window.receive(peer, message.seq, monotonic(), last=ends, size=len(data))
        self._reply(actions)
        return message if Deliver() in actions else None

    def acknowledge(self, position: Position) -> None:
        """Acknowledge all that was received; it is stored up to `position.seq`, except the last `position.unsaved`."""
        self._reply(self.window.acknowledge(position))

    def answer(self, position: Position) -> None:
        """Send the position, up to which all is stored, to the senders that asked for it."""
        self._reply(self.window.answer(position))

    def close(self) -> None:
        """Close, after the sender if it has sent its end: a connection that breaks may cost it the last reply."""
        if self.window.ended and self.window.connected:
            self._read_events(LINGER_SECONDS, until=Event.DISCONNECTED)
        super().close()

    def _disconnected(self) -> None:
        super()._disconnected()
        self.window.disconnected()

    def _reply(self, actions: Sequence[Deliver | Reply | Reject]) -> None:
        for action in actions:
            match action:
                case Reply(peer, answer):
                    with contextlib.suppress(zmq.Again):  # a sender that does not read asks again
                        self._socket.send_multipart([peer, self._encode(answer)], zmq.NOBLOCK)
                case Reject(reason, text):
                    self._reject(reason, text)
