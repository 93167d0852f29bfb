"""The acknowledged window: go-back-N retransmission as two state machines, without sockets and without a clock.

Events and the time in seconds go in; frames to transmit and replies come out. `catstream.wire.acknowledged`
connects the machines to sockets.

The sender numbers its messages 1, 2, 3 ... (`seq`). It keeps a copy of each until the receiver acknowledges
it: at most `size` copies, and no further one once they take 256 MiB. The receiver delivers each message to the
application once and in order, and replies once the application has processed it:

    Stored      acknowledges messages: those up to `taken` are processed, and the sender drops its copies up to `seq`
    Position    requests a retransmission of everything after `seq`

The receiver replies with a Position if a message is missing, and if the sender asks (with an empty frame, the
hello) on another connection than that of the last message. On the same one it replies with a Stored, as a connection
loses no message while it lasts; for the same reason, the sender goes back once for several Positions. It asks if it was
restarted, and after `PATIENCE_SECONDS` without a reply while messages wait. So either side may be restarted, any
connection may break, and any reply may be lost: each message is still delivered once, in order. The end of the stream
is delivered at any `seq` up to the next one: a restarted sender may end before it has repeated all that was delivered.

`Stored.seq` may include messages that the receiver has only in memory, because its disk cannot be written; `unsaved`
is their number. If such a receiver is restarted, the sender cannot retransmit them and raises `StreamRewoundError`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from catstream.errors import ProtocolError, StreamRewoundError
from catstream.messages.kinds import Position, Stored

PATIENCE_SECONDS = 0.2  #: without a reply, after which a sender asks for the position; between two reports of a gap
AGAIN_SECONDS = 2.0  #: within which a sender goes back once only on the same connection

#: The frame by which a sender asks for the receiver's position.
HELLO = b""

_MOST_BYTES = 256 << 20  # total size of the copies at which no further one is added
_MAX_CHANGES = 65536  # newest samples that a sender remembers until it is asked for them
_MAX_ASKING = 64  # peers that may wait for a position at a time; any other asks again


@dataclass(frozen=True, slots=True)
class Deliver:
    """The message that was just received is the next one in order: give it to the application."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Send a message to a peer."""

    peer: bytes
    message: Stored | Position


@dataclass(frozen=True, slots=True)
class Reject:
    """A frame broke the protocol: count it under `reason`, log `text`."""

    reason: str
    text: str


class SendWindow:
    """The sender's side.

    Parameters
    ----------
    channel : name of the channel, for errors
    size : unacknowledged messages that are kept at most; fewer if they are large
    now : the time

    Attributes
    ----------
    sent : newest seq that was pushed
    acknowledged : newest seq that the receiver will not ask for again while it lives
    stored : newest seq that survives the receiver's death; below `acknowledged` while its disk cannot be written
    taken : newest seq that the receiver has processed
    versions : version of the newest sample of each object that the receiver has made, by name
    """

    def __init__(self, channel: str, size: int, now: float) -> None:
        self.sent = self.acknowledged = self.stored = self.taken = 0
        self._channel, self._size = channel, size
        self._unacknowledged: deque[tuple[int, bytes]] = deque()  # oldest first
        self._bytes = 0  # their total size
        self._in_flight = 0  # how many of them were transmitted since the last Position
        self._sent_before = 0  # newest seq that a sender before this one may have sent
        self._last_reply = now
        self._went_back = -math.inf  # when it last did, on the present connection
        self.versions: dict[str, int] = {}
        self._changes: deque[tuple[int, str, int]] = deque()  # seq that led to a version of an object; 0: it is gone
        self._versions: dict[str, int] = {}  # that `count_samples` returned last

    def resume(self, seq: int, position: Position) -> None:
        """Continue after message `seq` of an earlier sender, of which the receiver is at `position`."""
        self.sent = self.acknowledged = self.taken = seq
        self.stored = min(seq, position.seq - position.unsaved)
        self._sent_before = position.seq + self._size  # a whole window of the earlier sender may still be on its way

    @property
    def full(self) -> bool:
        """Whether no message can be pushed now."""
        return len(self._unacknowledged) >= self._size or self._bytes >= _MOST_BYTES

    @property
    def limit(self) -> int:
        """Newest seq that can be pushed before anything else is acknowledged."""
        return self.sent if self.full else self.sent + 1

    def push(self, seq: int, frame: bytes) -> None:
        """Accept the next message for transmission.

        Raises
        ------
        ValueError
            If the window is full.
        """
        if self.full:
            kept = f"{len(self._unacknowledged)} of {self._bytes} bytes"
            raise ValueError(f"message {seq} of {self._channel} was pushed while {kept} are not acknowledged")
        self._unacknowledged.append((seq, frame))
        self._bytes += len(frame)
        self.sent = seq

    def transmit(self, send: Callable[[bytes], object]) -> None:
        """Send each frame that was not transmitted yet, until all were or `send` raises an error."""
        while self._in_flight < len(self._unacknowledged):
            send(self._unacknowledged[self._in_flight][1])
            self._in_flight += 1

    def must_ask(self, now: float) -> bool:
        """Whether to send a hello now: messages wait, and the last reply or hello is `PATIENCE_SECONDS` ago."""
        return bool(self._unacknowledged) and now - self._last_reply > PATIENCE_SECONDS

    def position_requested(self, now: float) -> None:
        """Note that a hello was sent."""
        self._last_reply = now

    def receive(self, reply: Stored | Position, now: float) -> Reject | None:
        """Process a reply.

        Raises
        ------
        ProtocolError
            If the receiver has stored messages that were never sent: it holds another stream.
        StreamRewoundError
            If the receiver needs messages that it had acknowledged before, and that were forgotten here.
        """
        if reply.seq > max(self.sent, self._sent_before):
            raise ProtocolError(
                f"the receiver of {self._channel} has stored message {reply.seq}, only {self.sent} were sent: "
                "it holds another stream: restart it, or start this process with --resume"
            )
        if isinstance(reply, Position):
            self._go_back(reply, now)
        elif reply.seq < self.acknowledged or reply.taken < self.taken:
            before = f"{self.taken} were processed and {self.acknowledged} acknowledged before"
            return Reject("acknowledgement", f"expected no step back ({before}), got {reply.taken} and {reply.seq}")
        self._last_reply = now
        self._note_samples(reply.versions)
        self._forget(reply)
        self.taken = min(reply.seq if isinstance(reply, Position) else reply.taken, self.sent)
        return None

    def count_samples(self, seq: int) -> dict[str, int]:
        """Count the samples that the messages up to `seq`, which never falls, led to; returns the newest versions.

        If the receiver did not reply to each message, a sample counts from the first message that it may be of.
        """
        while self._changes and self._changes[0][0] <= seq:
            self._count_oldest()
        return dict(self._versions)

    def _count_oldest(self) -> None:
        """Count the oldest change."""
        _, name, version = self._changes.popleft()
        self._versions[name] = version
        if not version:
            del self._versions[name]

    def _note_samples(self, replied: dict[str, int]) -> None:
        """Remember which versions are new with a reply; those of an object never fall while it is named."""
        before = self.versions
        self.versions = {name: max(version, before.get(name, 0)) for name, version in replied.items()}
        for name in before.keys() | self.versions.keys():
            if (version := self.versions.get(name, 0)) != before.get(name, 0):
                self._changes.append((self.taken + 1, name, version))
                if len(self._changes) > _MAX_CHANGES:
                    self._count_oldest()

    def disconnected(self) -> None:
        """The connection ended, and what was in flight may be lost."""
        self._went_back = -math.inf

    def _go_back(self, position: Position, now: float) -> None:
        """Transmit everything again that the receiver has not, unless that is on its way already."""
        if position.seq < self.acknowledged:
            raise StreamRewoundError(
                f"the receiver of {self._channel} had {self.acknowledged} messages and now has {position.seq}: "
                "what came between is made again from the source"
            )
        if now - self._went_back > AGAIN_SECONDS:
            self._went_back, self._in_flight = now, 0

    def _forget(self, reply: Stored | Position) -> None:
        while self._unacknowledged and self._unacknowledged[0][0] <= reply.seq:
            self._bytes -= len(self._unacknowledged.popleft()[1])
            self._in_flight = max(self._in_flight - 1, 0)
        self.acknowledged = max(self.acknowledged, min(reply.seq, self.sent))
        self.stored = max(self.stored, min(reply.seq - reply.unsaved, self.sent))


class ReceiveWindow:
    """The receiver's side.

    Parameters
    ----------
    position : where the stream continues; the next message delivered is the one after `position.seq`
    size : unacknowledged messages that the sender keeps at most

    Attributes
    ----------
    taken : newest seq that was delivered; it is processed before `acknowledge` and the next `receive`
    ended : whether the sender has sent the end of the stream
    connected : whether the sender of the newest message was still connected when a message was last awaited
    """

    def __init__(self, position: Position, size: int) -> None:
        self.taken = position.seq
        self.ended = self.connected = False
        self._position, self._size = position, size
        self._bytes = 0  # total size of the messages that were delivered since all were stored
        self._peer: bytes | None = None  # the sender of the last message: acknowledgements go to it only
        self._asking: dict[bytes, None] = {}  # peers that wait for `answer`, in order
        self._gap_reported = -math.inf  # when a missing message was last reported

    @property
    def position_requested(self) -> bool:
        """Whether a sender waits for `answer`: it asked for the position, and more was delivered than is stored."""
        return bool(self._asking)

    @property
    def half_full(self) -> bool:
        """Return whether half of the sender's window is not stored yet: the sender waits while its window is full."""
        return 2 * (self.taken - self._position.seq) >= self._size or 2 * self._bytes >= _MOST_BYTES

    def hello(self, peer: bytes) -> list[Reply]:
        """A sender asks for the position; it is answered at once if it only waits, or if all messages are stored."""
        if peer == self._peer:
            return [Reply(peer, self._stored())]
        if self._position.seq >= self.taken:
            return [Reply(peer, self._position)]
        if len(self._asking) < _MAX_ASKING:
            self._asking[peer] = None
        return []

    def receive(
        self, peer: bytes, seq: int, now: float, last: bool = False, size: int = 0
    ) -> list[Deliver | Reply | Reject]:
        """A message of `size` bytes arrived; `last` says whether it is the end of the stream."""
        ends = last and not self.ended  # also before a restarted sender has repeated what was delivered
        if seq <= self.taken and not ends:  # retransmitted: the sender does not know that it arrived
            return [Reply(peer, self._stored())]
        if seq <= self.taken + 1:
            self.taken, self.ended, self._bytes = max(seq, self.taken), last, self._bytes + size
            self._peer, self.connected, self._gap_reported = peer, True, -math.inf
            return [Deliver()]
        actions: list[Deliver | Reply | Reject] = []
        if seq > self.taken + self._size + 1:  # more than a sender may have in flight
            actions.append(Reject("sequence", f"message {seq} came after {self.taken}"))
        if now - self._gap_reported > PATIENCE_SECONDS:
            self._gap_reported = now
            actions.append(Reply(peer, self._position))
        return actions

    def acknowledge(self, position: Position) -> list[Reply]:
        """All delivered messages are processed, and stored up to `position.seq`, except the last `position.unsaved`."""
        self._note_position(position)
        return [] if self._peer is None else [Reply(self._peer, self._stored())]

    def answer(self, position: Position) -> list[Reply]:
        """Answer all that asked for the position."""
        self._note_position(position)
        replies = [Reply(peer, position) for peer in self._asking]
        self._asking.clear()
        return replies

    def disconnected(self) -> None:
        """A connection ended: it may be the sender's."""
        self.connected = False

    def _note_position(self, position: Position) -> None:
        self._position = position
        if position.seq >= self.taken:
            self._bytes = 0

    def _stored(self) -> Stored:
        at = self._position
        return Stored(at.seq, self.taken, at.versions, at.unsaved)
