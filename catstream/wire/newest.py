"""Publish/subscribe channels with any number of subscribers.

The publisher binds an XPUB socket, subscribers connect SUB sockets. They subscribe to everything (the empty topic), to
one kind of message, or to the messages of one kind about one object (the bytes that these messages begin with, see
`catstream.wire.codec.opening`). The publisher never waits for a subscriber: a slow one misses messages.

If a channel keeps the newest message, the newest of each object is sent to late joiners, and once per second to all
subscribers, because a burst may have cost one of them the last messages. A `Subscriber` drops repeats. At most half as
many messages as fit into the queue of a subscriber are repeated at once.

The number of topics that a peer can make either side remember is limited.
"""

from __future__ import annotations

from collections.abc import Iterable
from time import monotonic
from typing import TypeVar

import zmq

from catstream.wire.channels import Channel
from catstream.wire.codec import Topic, opening, topic_of
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Features, Health, Track
from catstream.wire.monitor import arrives
from catstream.wire.socket import ChannelSocket

REPEAT_SECONDS = 1.0  #: after which the last messages are sent again
_MOST_KEPT = 256  # newest messages that are kept, one of each object
_MOST_TOPICS = 1024  # topics that a publisher knows the subscribers of, and that a subscriber knows the last message of
_MAX_CHANGES = 1000  # subscriptions that are processed at once
_MAX_SUBSCRIPTION_BYTES = 4096

_END = opening(End)

Message = TypeVar("Message")


class Publisher(ChannelSocket[Message]):
    """Publishes without blocking on slow subscribers; `sender` is one of the channel's senders if there are several."""

    def __init__(self, channel: Channel[Message], endpoint: Endpoint, sender: str | None = None) -> None:
        self._newest = channel.keeps == "newest"
        super().__init__(zmq.XPUB, channel, endpoint, channel.high_water_mark)
        self._socket.set(zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION_BYTES)
        self._socket.set(zmq.XPUB_VERBOSE, 1)  # report every subscription, not only the first of a topic
        self._kinds = tuple(map(opening, channel.messages))  # the beginnings of topics that may be subscribed to
        self._subscribed: set[bytes] = set()
        self._last: dict[Topic, bytes] = {}  # the messages for late joiners, in the order of sending
        self._repeat_at = 0.0
        self._bind(sender)

    @property
    def has_subscribers(self) -> bool:
        """True if more than the end had a subscriber when `send` or `serve_late_joiners` was last called."""
        return not self._subscribed <= {_END}

    def send(self, message: Message) -> None:
        """Send to all subscribers; on a channel that keeps the newest message, also to late joiners."""
        self.serve_late_joiners()
        if not (self._newest or self._subscribed):
            return
        data = self._encode(message)
        if self._newest:
            if isinstance(message, End):  # nothing before it counts
                self._last.clear()
            self._last.pop(topic := topic_of(data), None)
            self._last[topic] = data
            if len(self._last) > _MOST_KEPT:
                del self._last[next(iter(self._last))]
            self._repeat_at = self._repeat_at or monotonic() + REPEAT_SECONDS
        self._socket.send(data, copy=False)

    def keep_only(self, objects: Iterable[str]) -> None:
        """Send late joiners only messages about these objects from now on."""
        names = set(objects)
        self._last = {topic: data for topic, data in self._last.items() if topic.object in names}

    def serve_late_joiners(self) -> None:
        """Process subscriptions; send some of the last messages again if it is time. Call once per iteration."""
        self._read_events()
        joined = False
        for _ in range(_MAX_CHANGES):  # the rest waits for the next call: a flood does not stop the process
            if not arrives(self._socket, 0):
                break
            joined |= self._process(self._socket.recv())
        if not self._last or not (joined or monotonic() >= self._repeat_at):
            return
        # As many of the last messages as half the queue of a subscriber holds; they are put at the back.
        topics = list(self._last)[: max(1, self.channel.high_water_mark // 2)]
        for topic in topics:
            self._last[topic] = data = self._last.pop(topic)
            self._socket.send(data, copy=False)
        self._repeat_at = monotonic() + REPEAT_SECONDS * len(topics) / len(self._last)

    def _process(self, change: bytes) -> bool:
        """Process one subscription or its end; returns whether there is a new subscriber."""
        subscribes, topic = change.startswith(b"\x01"), change[1:]
        if topic and not topic.startswith(self._kinds):
            expected = "expected a subscription to everything, to a kind of message, or to one object"
            self._reject("subscription", f"a message was dropped: {expected}")
        elif subscribes and topic not in self._subscribed and len(self._subscribed) >= _MOST_TOPICS:
            self._reject("topics", f"a subscription was not counted: expected at most {_MOST_TOPICS} topics")
        elif subscribes:
            self._subscribed.add(topic)
            return True
        else:  # its last subscriber has left
            self._subscribed.discard(topic)
        return False


class Subscriber(ChannelSocket[Message]):
    """Receives messages that are published from now on; if the channel keeps the newest message, the last ones first.

    If the channel keeps the newest message, older ones of the same object are passed over. The objects take turns: the
    message of the object that has waited longest is received first. `only` limits it to one kind of message, and
    `about` to this kind of messages about one object. With `newest`, this holds for any channel.
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        only: type | None = None,
        *,
        about: str | None = None,
        newest: bool = False,
    ) -> None:
        self._newest = channel.keeps == "newest"
        self._passes_over = (newest or self._newest) and len(channel.senders) == 1
        super().__init__(zmq.SUB, channel, endpoint, channel.high_water_mark)
        self._socket.set(zmq.LINGER, 0)  # while a publisher is away, its subscriptions wait to be sent again
        self._arrived: dict[Topic, bytes] = {}  # newest message of each topic, the topic that waits longest first
        self._last: dict[tuple[Topic, str], object] = {}  # identity of the last message of each object or process
        self._socket.subscribe(b"" if only is None else opening(only, about))
        self._connect()

    def pending(self) -> bool:
        """Return True if something has arrived that was not received yet."""
        return bool(self._arrived) or super().pending()

    def receive(self, seconds: float) -> Message | None:
        """The next message, None if none arrived in time; repeats and invalid messages are skipped."""
        deadline = monotonic() + seconds
        while (data := self._next_data(deadline)) is not None:
            message = self._decode(data, *self.channel.messages)
            if message is not None and not self._is_repeat(message, data):
                return message
        return None

    def receive_all(self, seconds: float = 0.0) -> list[Message]:
        """All messages that have arrived, oldest first; if none has, wait at most this long for one."""
        first = self.receive(seconds)
        return [] if first is None else [first, *iter(lambda: self.receive(0), None)]

    def _next_data(self, deadline: float) -> bytes | None:
        """The next message as it arrived, None if none arrives before the deadline.

        It is a copy: the destructor of a zmq.Frame handles signals, and Python ignores an exception raised there.
        """
        if not self._passes_over:
            return self._socket.recv() if self._wait(deadline - monotonic()) else None
        while len(self._arrived) < _MOST_KEPT and self._wait(0 if self._arrived else deadline - monotonic()):
            data = self._socket.recv()
            self._arrived[topic_of(data)] = data  # in the place of an older one
        return self._arrived.pop(next(iter(self._arrived))) if self._arrived else None

    def _is_repeat(self, message: Message, data: bytes) -> bool:
        """Return True if a message is the last one of its object or process, which is sent again now and then.

        It is identified by its version. A message without a version is small, and identified by all of its bytes.
        """
        if not self._newest:
            return False
        about = message.process if isinstance(message, Health) else getattr(message, "object", "")
        source = Topic(type(message).__name__, about), self.run
        version = getattr(message, "version", None)
        identity = hash(data) if version is None else (version, getattr(message, "began", 0))
        before = self._last.pop(source, None)
        self._last[source] = identity
        if len(self._last) > _MOST_TOPICS:
            del self._last[next(iter(self._last))]
        return before == identity


class GapCounter:
    """Counts lost frames of a stream by the gaps in the numbers of the frames of its messages, which start with 0.

    The tracks of all objects in a frame have the same number. A restarted sender may repeat numbers.

    missed  frames without a message, between the first and the last received frame
    before  frames before the first message that was received
    """

    def __init__(self, *, of_one_object: bool = False) -> None:
        self.missed = self.before = self._next = 0
        self._of_one_object = of_one_object
        self._began: int | None = None  # frame in which the one object began: there were no messages before

    def take(self, message: Track | Features) -> None:
        """Count the frames missing before the next message."""
        if self._of_one_object and isinstance(message, Track) and message.began != self._began:
            self._began = message.began
            self._next = message.frame + 1
        else:
            self._count(message.frame)

    def end(self, end: End) -> None:
        """Count the frames missing before the end; one object may have been forgotten before it."""
        if not self._of_one_object:
            self._count(end.frame)

    def _count(self, frame: int) -> None:
        if self._next:
            self.missed += max(0, frame - self._next)
        else:
            self.before = frame
        self._next = frame + 1
