"""Published channels (`samples`, `models`, `tracks`, `health`, `previews`, `training`): any number of subscribers.

The publisher binds an XPUB socket, subscribers connect SUB sockets. They subscribe to everything (the empty topic), to
one kind of message, or to the messages of one kind about one object (the bytes that these messages begin with, see
`catstream.wire.codec.opening`). The publisher never waits for a subscriber: one that falls too far behind misses
messages.

If a channel keeps the newest message, it keeps that of each object. They are transmitted again to late joiners, and to
all if nothing newer followed within 0.2 s, 0.6 s, 1.4 s ...: a burst may have cost a subscriber the last ones. A
`Subscriber` drops repeats. No more are repeated at once than the queue of a subscriber holds, and the rate halves each
time, so that all of them reach any subscriber that is not frozen.

A subscriber that waits for a pipeline of the same user on the same machine leaves a note with its name, and also
subscribes to this name. A publisher of a channel that keeps every message reads these notes when it starts, and knows
by the subscriptions which of the `awaited` ones are connected: the detector begins with its first frame then.

The number of topics that a peer can make either side remember is limited.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Iterable
from hashlib import blake2b
from time import monotonic
from typing import TypeVar

import zmq

from catstream.messages.kinds import End, Health, Run
from catstream.wire.channels import Channel
from catstream.wire.codec import opening, topic_of
from catstream.wire.context import arrives
from catstream.wire.endpoint import Endpoint, Note, names_of_early_subscribers, note_early_subscriber
from catstream.wire.socket import ChannelSocket
from catstream.wire.timing import REPEAT_SECONDS

_MOST_KEPT = 256  # newest messages that are kept, one of each object
_MOST_TOPICS = 1024  # topics that a publisher knows the subscribers of, and that a subscriber knows the last message of
_MAX_CHANGES = 1000  # subscriptions that are processed at once
_MAX_SUBSCRIPTION_BYTES = 4096
_COMPARED_BYTES = 1 << 12  # at either end of a message, by which a repeat is known
_NAME = b"\xffreader "  # begins the topic by which a subscriber gives its name; no message begins with it

_ENDS = {opening(End)}

Message = TypeVar("Message")


class Publisher(ChannelSocket[Message]):
    """Sends to all subscribers, and waits for none.

    Parameters
    ----------
    sender : which of the channel's senders this is, if there are several
    first_message : message that is sent whenever a subscriber connects; on a channel that keeps every message

    Attributes
    ----------
    awaited : names of the subscribers that should be connected before the first message, and are not yet
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        sender: str | None = None,
        first_message: Message | None = None,
    ) -> None:
        self._newest = channel.keeps == "newest"
        super().__init__(zmq.XPUB, channel, endpoint, channel.high_water_mark)
        self._socket.set(zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION_BYTES)
        self._socket.set(zmq.XPUB_VERBOSE, 1)  # report every subscription, also one that another subscriber has
        self._kinds = tuple(map(opening, channel.messages))  # the beginnings of topics that may be subscribed to
        self._subscribed: set[bytes] = set()
        self.awaited = set() if self._newest else names_of_early_subscribers(channel, endpoint)
        self._last: dict[bytes, bytes] = {}  # the messages for late joiners by topic, oldest first
        if first_message is not None:
            self._last[b""] = self._encode(first_message)
        self._due: list[bytes] = []  # topics whose last message is sent again, in this order
        self._next_part = 0.0  # when some of them are sent
        self._repeat_at, self._pause = math.inf, REPEAT_SECONDS  # when all are due again; seconds from time to time
        self._bind(sender)

    @property
    def has_subscribers(self) -> bool:
        """Whether more than the end had a subscriber when `send` or `serve_late_joiners` was last called."""
        return not self._subscribed <= _ENDS

    def send(self, message: Message) -> None:
        """Send to all subscribers; on a channel that keeps the newest message, later to late joiners too."""
        if not self._newest:
            self.serve_late_joiners()
            if self._subscribed:
                self._socket.send(self._encode(message), copy=False)
            return
        data = self._encode(message)
        if isinstance(message, End):  # nothing before it counts
            self._last.clear()
        self._last.pop(topic := topic_of(data), None)
        self._last[topic] = data
        if len(self._last) > _MOST_KEPT:
            del self._last[next(iter(self._last))]
        self._socket.send(data, copy=False)
        self._repeat_after(REPEAT_SECONDS)
        self.serve_late_joiners()

    def keep_only(self, objects: Iterable[str]) -> None:
        """Send late joiners only messages about these objects from now on."""
        topics = {opening(kind, name) for kind in self.channel.messages for name in objects}
        self._last = {topic: data for topic, data in self._last.items() if topic in topics}

    def serve_late_joiners(self) -> None:
        """Process subscriptions; send the first message or the last ones again if due. Call once per iteration."""
        self._read_events()
        joined = False
        for _ in range(_MAX_CHANGES):  # the rest waits for the next call: a flood does not stop the process
            if not arrives(self._socket, 0):
                break
            change = self._socket.recv()
            joined |= self._process(subscribes=change.startswith(b"\x01"), topic=change[1:])
        if joined or monotonic() >= self._repeat_at:
            self._due = list(dict.fromkeys([*self._due, *self._last]))
            self._next_part = 0.0
            if self._newest:
                self._repeat_after(REPEAT_SECONDS if joined else 2 * self._pause)
        if self._due and monotonic() >= self._next_part:
            self._repeat_part()

    def _repeat_after(self, seconds: float) -> None:
        """Send the last messages again after so many seconds."""
        self._repeat_at, self._pause = monotonic() + seconds, seconds

    def _repeat_part(self) -> None:
        """Send as many of the due messages again as half the queue of a subscriber holds."""
        count = max(1, self.channel.high_water_mark // 2)
        for topic in self._due[:count]:
            if (data := self._last.get(topic)) is not None:
                self._socket.send(data, copy=False)
        del self._due[:count]
        self._next_part = monotonic() + self._pause * min(1.0, count / max(1, len(self._last)))

    def _process(self, subscribes: bool, topic: bytes) -> bool:
        """Process one subscription or its end; returns whether there is a new subscriber."""
        if topic.startswith(_NAME):
            self.awaited.discard(topic.removeprefix(_NAME).decode(errors="replace"))
        elif topic and not topic.startswith(self._kinds):
            self._reject(
                "subscription",
                "a message was dropped: expected a subscription to everything, to a kind of message, or to one object",
            )
        elif subscribes and topic not in self._subscribed and len(self._subscribed) >= _MOST_TOPICS:
            self._reject("subscription", f"a subscription was not counted: expected at most {_MOST_TOPICS} topics")
        elif subscribes:
            self._subscribed.add(topic)
            return True
        else:  # its last subscriber has left
            self._subscribed.discard(topic)
        return False


class Subscriber(ChannelSocket[Message]):
    """Receives what is published from now on; if the channel keeps the newest message, the last ones first.

    If the channel keeps the newest message, older ones of the same object are passed over. The objects take turns: the
    message of the object that has waited longest is received first.

    Parameters
    ----------
    only : the one kind of message to receive; None for all
    about : name of the one object whose messages of this kind are received; None for all
    every : on a channel that keeps the newest message, receive older ones too, as far as they arrive
    early : whether a pipeline that starts later, on this machine as this user, waits for this subscriber
    name : by which the publisher may wait for this subscriber; if `early`, a new one
    """

    def __init__(
        self,
        channel: Channel[Message],
        endpoint: Endpoint,
        only: type | None = None,
        *,
        about: str | None = None,
        every: bool = False,
        early: bool = False,
        name: str = "",
    ) -> None:
        self._newest = channel.keeps == "newest"
        self._passes_over = self._newest and len(channel.senders) == 1 and not every
        super().__init__(zmq.SUB, channel, endpoint, channel.high_water_mark)
        self._socket.set(zmq.LINGER, 0)  # while a publisher is away, its subscriptions wait to be sent again
        self._arrived: dict[bytes, zmq.Frame] = {}  # newest message of each topic, the topic that waits longest first
        self._last: dict[bytes, bytes] = {}  # digest of the last message of each topic or process, to drop repeats
        self._socket.subscribe(b"" if only is None else opening(only, about))
        self._note: Note | None = None
        if early:
            name = secrets.token_hex(8)
            self._note = note_early_subscriber(name, channel, endpoint)
        if name:  # after the topic of the messages: subscriptions are transmitted in order, the empty one first
            self._socket.subscribe(_NAME + name.encode())
        self._connect()

    def pending(self) -> bool:
        """Whether something has arrived that was not received yet."""
        return bool(self._arrived) or super().pending()

    def receive(self, seconds: float) -> Message | None:
        """The next message, None if none arrived in time; repeats and what is rejected are passed over."""
        deadline = monotonic() + seconds
        while (frame := self._next_frame(deadline)) is not None:
            message = self._decode(frame.buffer, *self.channel.messages)
            if message is not None and (not self._newest or self._remember(message, frame.buffer)):
                if not isinstance(message, Run):  # it has heard the pipeline: no other one has to wait for it
                    self._remove_note()
                return message
        return None

    def receive_all(self, seconds: float = 0.0) -> list[Message]:
        """All messages that have arrived, oldest first; if none has, wait at most this long for one."""
        first = self.receive(seconds)
        return [] if first is None else [first, *iter(lambda: self.receive(0), None)]

    def close(self) -> None:
        """Disconnect."""
        self._remove_note()
        super().close()

    def _remove_note(self) -> None:
        if self._note is not None:
            self._note.close()
            self._note = None

    def _next_frame(self, deadline: float) -> zmq.Frame | None:
        """The next message as it arrived, None if none arrives before the deadline."""
        if not self._passes_over:
            return self._socket.recv(copy=False) if self._wait(deadline - monotonic()) else None
        while len(self._arrived) < _MOST_KEPT and self._wait(0 if self._arrived else deadline - monotonic()):
            frame = self._socket.recv(copy=False)
            self._arrived[topic_of(frame.buffer)] = frame  # in the place of an older one
        return self._arrived.pop(next(iter(self._arrived))) if self._arrived else None

    def _remember(self, message: Message, data: memoryview) -> bool:
        """Remember a message as the last one of its process or topic.

        Returns False if the one before was the same: it was sent again to a late joiner.
        """
        sender = message.process.encode() if isinstance(message, Health) else topic_of(data)
        # Its numbers are at the beginning: to read megabytes of rows would take as long as training.
        ends = bytes(data[:_COMPARED_BYTES]) + bytes(data[-_COMPARED_BYTES:])
        before, digest = self._last.pop(sender, None), blake2b(ends, digest_size=16).digest()
        self._last[sender] = digest
        if len(self._last) > _MOST_TOPICS:
            del self._last[next(iter(self._last))]
        return before != digest


class GapCounter:
    """Counts lost frames of a stream by the gaps in the numbers `seq` of its messages, which start with 1.

    The tracks of all objects in a frame have the same number. A restarted sender may repeat numbers.

    missed  frames without a message between the first and the last one that was received
    before  frames before the first message that was received
    """

    def __init__(self) -> None:
        self.missed = self.before = self._seq = 0
        self._began: int | None = None

    def take(self, seq: int, began: int | None = None) -> None:
        """Count the frames missing before the number of the next message, or of the end.

        Parameters
        ----------
        began : first frame of the object if messages about one object are counted: there were none before that frame
        """
        if began is not None and began != self._began:
            self._began = began
        elif self._seq:
            self.missed += max(0, seq - self._seq - 1)
        else:
            self.before = max(0, seq - 1)
        self._seq = seq
