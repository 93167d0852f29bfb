"""Publish/subscribe channels with any number of subscribers.

The publisher binds an XPUB socket, subscribers connect SUB sockets. They subscribe to everything (the empty topic), to
one kind of message, or to the messages of one kind about one object (the bytes that these messages begin with, see
`catstream.wire.codec.opening`). The publisher never waits for a subscriber: a slow one misses messages.

If a channel keeps the newest message, the publisher sends the newest of each object to late joiners, and once per
second to all subscribers, because a burst may have cost one of them the last messages. A `Subscriber` drops repeats.
At once, at most half a subscriber's queue is repeated.

Both sides limit the number of topics that a peer can make them store.
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

REPEAT_SECONDS = 1.0  #: interval at which the last messages are sent again
_MOST_STORED = 256  # newest messages that are stored, one of each object
_MOST_TOPICS = 1024  # subscribed topics that a publisher stores, and last messages that a subscriber stores
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
        self._kinds = tuple(map(opening, channel.messages))  # prefixes of valid topics
        self._subscribed: set[bytes] = set()
        self._last: dict[Topic, bytes] = {}  # the messages for late joiners, in the order of sending
        self._repeat_at = 0.0
        self._bind(sender)

    @property
    def has_subscribers(self) -> bool:
        """True if a message other than `End` had a subscriber at the last `send` or `serve_late_joiners`."""
        return not self._subscribed <= {_END}

    def send(self, message: Message) -> None:
        """Send to all subscribers; on a channel that keeps the newest message, also to late joiners."""
        self.serve_late_joiners()
        if not (self._newest or self._subscribed):
            return
        data = self._encode(message)
        if self._newest:
            if isinstance(message, End):  # supersedes all messages before it
                self._last.clear()
            self._last.pop(topic := topic_of(data), None)
            self._last[topic] = data
            if len(self._last) > _MOST_STORED:
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
        for _ in range(_MAX_CHANGES):  # a flood must not block the process: the rest waits for the next call
            if not arrives(self._socket, 0):
                break
            joined |= self._process(self._socket.recv())
        if not self._last or not (joined or monotonic() >= self._repeat_at):
            return
        # Send as many as fill half of a subscriber's queue, and move them to the back.
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
        else:  # XPUB reports the end of a topic's last subscription
            self._subscribed.discard(topic)
        return False


class Subscriber(ChannelSocket[Message]):
    """Receives messages that are published from now on; if the channel keeps the newest message, the last ones first.

    If the channel keeps the newest message, or with `newest`, older messages of the same object are dropped; the object
    that has waited longest is served first. `only` limits it to one kind of message, `about` to messages of this kind
    about one object.
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
        self._conflates = (newest or self._newest) and len(channel.senders) == 1
        super().__init__(zmq.SUB, channel, endpoint, channel.high_water_mark)
        self._socket.set(zmq.LINGER, 0)  # do not wait at the exit to send subscriptions to a lost publisher
        self._arrived: dict[Topic, bytes] = {}  # newest message of each topic, longest-waiting topic first
        self._last: dict[tuple[Topic, str], object] = {}  # identity of the last message of each object or process
        self._socket.subscribe(b"" if only is None else opening(only, about))
        self._connect()

    def pending(self) -> bool:
        """Return True if a message has arrived that was not received yet."""
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
        """All messages that have arrived, oldest first; waits up to `seconds` for the first one."""
        first = self.receive(seconds)
        return [] if first is None else [first, *iter(lambda: self.receive(0), None)]

    def _next_data(self, deadline: float) -> bytes | None:
        """The next message as bytes, None if none arrives before the deadline.

        It is a copy: the destructor of a zmq.Frame handles signals, and Python ignores an exception raised there.
        """
        if not self._conflates:
            return self._socket.recv() if self._wait(deadline - monotonic()) else None
        while len(self._arrived) < _MOST_STORED and self._wait(0 if self._arrived else deadline - monotonic()):
            data = self._socket.recv()
            self._arrived[topic_of(data)] = data  # replaces an older one, and keeps its position in the queue
        return self._arrived.pop(next(iter(self._arrived))) if self._arrived else None

    def _is_repeat(self, message: Message, data: bytes) -> bool:
        """Return True if a message repeats the last one of its object or process.

        Messages are identified by their version; those without a version are small, and identified by all bytes.
        """
        if not self._newest:
            return False
        about = message.process if isinstance(message, Health) else getattr(message, "object", "")
        source = Topic(type(message).__name__, about), self.run
        version = getattr(message, "version", None)
        identity = hash(data) if version is None else (version, getattr(message, "began", 0))
        previous = self._last.pop(source, None)
        self._last[source] = identity
        if len(self._last) > _MOST_TOPICS:
            del self._last[next(iter(self._last))]
        return previous == identity


class GapCounter:
    """Counts lost frames of a stream by the gaps in its frame numbers, which start with 0.

    The tracks of all objects in a frame have the same number. A restarted sender may repeat numbers.

    missed  frames without a message, between the first and the last received frame
    before  frames before the first received message
    """

    def __init__(self, *, of_one_object: bool = False) -> None:
        self.missed = self.before = self._next = 0
        self._of_one_object = of_one_object
        self._began: int | None = None  # first frame of the one object: it has no messages before
        self._run = ""

    def take(self, message: Track | Features, run: str = "") -> None:
        """Count the missing frames before the next message, of the run with this id."""
        if run != self._run:  # a new run may count from 0 again
            self._run, self._next = run, min(self._next, message.frame)
        if self._of_one_object and isinstance(message, Track) and message.began != self._began:
            self._began = message.began
            self._next = message.frame + 1
        else:
            self._count(message.frame)

    def end(self, end: End) -> None:
        """Count the missing frames before the end of the stream."""
        if not self._of_one_object:  # one object may have been forgotten earlier
            self._count(end.frame)

    def _count(self, frame: int) -> None:
        if self._next:
            self.missed += max(0, frame - self._next)
        else:
            self.before += frame
        self._next = max(self._next, frame + 1)
