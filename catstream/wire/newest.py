"""Published channels (`samples`, `models`, `tracks`, `health`, `previews`, `training`): any number of subscribers.

The publisher binds an XPUB socket, subscribers connect SUB sockets and subscribe to everything (the empty topic) or
to one kind of message (the bytes that all of its messages begin with). The publisher never waits for a subscriber: one
that falls too far behind misses messages.

If a channel keeps the newest message, it is transmitted again to late joiners, and once to all if nothing newer
followed within 0.2 s: a burst may have cost a subscriber the last one. A `Subscriber` drops repeats.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from hashlib import blake2b
from time import monotonic
from typing import TypeVar

import zmq

from catstream.messages import Health
from catstream.wire.channels import Channel
from catstream.wire.codec import encode, opening
from catstream.wire.endpoint import Endpoint
from catstream.wire.socket import ChannelSocket

__all__ = ["Publisher", "Subscriber"]

_NEWEST_SENT = 8  # messages that are queued for a subscriber if only the newest counts
_NEWEST_RECEIVED = 16
_MAX_CHANGES = 1000  # subscriptions that are processed at once
_MAX_SUBSCRIPTION_BYTES = 4096
_REPEAT_SECONDS = 0.2  # without a newer message, after which the last one is sent again
_READER = b"\xffreader "  # begins the topic that makes an announced subscriber known; no message begins with it

Message = TypeVar("Message")


class Publisher(ChannelSocket[Message]):
    """Sends to all subscribers, and waits for none.

    Parameters
    ----------
    sender : which of the channel's senders this is, if there are several
    first_message : message that is sent whenever a subscriber connects; on a channel that keeps every message
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        sender: str | None = None,
        first_message: Message | None = None,
    ) -> None:
        self._newest = channel.keeps == "newest"
        super().__init__(zmq.XPUB, channel, endpoint, _NEWEST_SENT if self._newest else channel.high_water_mark)
        self._socket.set(zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION_BYTES)
        self._socket.set(zmq.XPUB_VERBOSE, 1)  # report every subscription, also one that another subscriber has
        self._topics = {b"", *map(opening, channel.messages)}  # that may be subscribed to
        self._subscribed: set[bytes] = set()
        self._expected: set[bytes] = set()  # topics of announced subscribers that are not connected yet
        self._last: bytes | None = None if first_message is None else encode(first_message)
        self._repeat_at = math.inf
        self._bind(sender)

    @property
    def has_subscribers(self) -> bool:
        """Whether there was a subscriber when `send` or `serve_late_joiners` was last called."""
        return bool(self._subscribed)

    def expect(self, readers: Iterable[str]) -> None:
        """Name the announced subscribers that should be connected before the first message."""
        self._expected = {_READER + reader.encode() for reader in readers}

    @property
    def all_connected(self) -> bool:
        """Whether all that were expected were connected when `serve_late_joiners` was last called."""
        return not self._expected

    def send(self, message: Message) -> None:
        """Send to all subscribers; on a channel that keeps the newest message, later to late joiners too."""
        if not self._newest:
            self.serve_late_joiners()
            if self._subscribed:
                self._socket.send(encode(message), copy=False)
            return
        self._last, self._repeat_at = encode(message), monotonic() + _REPEAT_SECONDS
        self._socket.send(self._last, copy=False)
        self.serve_late_joiners()

    def serve_late_joiners(self) -> None:
        """Process subscriptions; send the first or the last message again if it is due. Call once per iteration."""
        self._read_events()
        due = monotonic() >= self._repeat_at
        for _ in range(_MAX_CHANGES):  # the rest waits for the next call: a flood does not stop the process
            try:
                change = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                break
            due |= self._process(subscribes=change.startswith(b"\x01"), topic=change[1:])
        if due and self._last is not None:
            self._repeat_at = math.inf
            self._socket.send(self._last, copy=False)

    def _process(self, subscribes: bool, topic: bytes) -> bool:
        """Process one subscription or its end; returns whether there is a new subscriber."""
        if topic.startswith(_READER):
            self._expected.discard(topic)
        elif topic not in self._topics:
            self._reject("subscription", "a message was dropped: one subscribes to everything, or to one kind")
        elif subscribes:
            self._subscribed.add(topic)
            return True
        else:  # its last subscriber has left
            self._subscribed.discard(topic)
        return False


class Subscriber(ChannelSocket[Message]):
    """Receives what is published from now on; if the channel keeps the newest message, the last one first.

    Parameters
    ----------
    only : the one kind of message to receive; None for all
    every : on a channel that keeps the newest message, receive older ones too, as far as they arrive
    reader : name by which this subscriber was announced, see `catstream.wire.announced`
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        only: type | None = None,
        *,
        every: bool = False,
        reader: str = "",
    ) -> None:
        self._newest = channel.keeps == "newest"
        super().__init__(zmq.SUB, channel, endpoint, _NEWEST_RECEIVED if self._newest else channel.high_water_mark)
        self._last: dict[str, bytes] = {}  # digest of the last message of each process, to drop repeats
        if self._newest and len(channel.senders) == 1 and not every:
            self._socket.set(zmq.CONFLATE, 1)
        self._socket.subscribe(b"" if only is None else opening(only))
        if reader:  # after the topic of the messages: subscriptions are transmitted in order, the empty one first
            self._socket.subscribe(_READER + reader.encode())
        self._connect()

    def pending(self) -> bool:
        """Whether something has arrived."""
        return self._wait(0)

    def receive(self, seconds: float) -> Message | None:
        """The next message, None if none arrived in time; repeats and what is rejected are passed over."""
        deadline = monotonic() + seconds
        while self._wait(deadline - monotonic()):
            frame = self._socket.recv(copy=False)
            message = self._decode(frame.buffer, *self.channel.messages)
            if message is not None and not (self._newest and self._is_repeat(message, frame.buffer)):
                return message
        return None

    def receive_all(self) -> list[Message]:
        """All messages that have arrived, oldest first."""
        return list(iter(lambda: self.receive(0), None))

    def _is_repeat(self, message: Message, data: memoryview) -> bool:
        """Whether the last message of the same process was the same: it was sent again to a late joiner."""
        sender = message.process if isinstance(message, Health) else ""
        before, digest = self._last.get(sender), blake2b(data, digest_size=16).digest()
        self._last[sender] = digest
        return before == digest
