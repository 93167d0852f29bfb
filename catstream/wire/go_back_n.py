"""The acknowledged window: go-back-N retransmission as two state machines, without sockets and without a clock.

Events and the time in seconds go in; frames to transmit and replies come out. `catstream.wire.acknowledged`
connects the machines to sockets.

The sender numbers its messages 1, 2, 3 ... (`seq`). It keeps a copy of each until the receiver acknowledges
it: at most `size` copies, and no further one once they take 256 MiB. The receiver delivers each message to the
application once and in order, and replies with a `Position` once the application has processed it: the sender drops its
copies of stored messages.

If a message is missing, or a sender asks for the position on another connection than the last message, the reply
says `again`: the sender transmits all messages after `processed` again. On the same connection none is lost; for
the same reason the sender goes back once for several such replies. It asks if it was restarted, and after
`PATIENCE_SECONDS` without a reply while messages wait. So either side may be restarted, any connection may break, and
any reply may be lost: each message is still delivered once, in order. The end of the stream is delivered at any `seq`
up to the next one: a restarted sender may end before it has repeated all that was delivered.

A message may be acknowledged although it is only in memory, because the disk cannot be written (`Position.in_memory`).
If such a receiver is restarted, the sender cannot retransmit it and raises `StreamRewoundError`: it has to make the
messages again from the source.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from catstream.errors import ProtocolError, StreamRewoundError
from catstream.wire.messages import Position

PATIENCE_SECONDS = 0.2  #: without a reply, after which a question is sent again; between two reports of a gap
AGAIN_SECONDS = 2.0  #: within which a sender goes back once only on the same connection

_MOST_BYTES = 256 << 20  # total size of the copies at which no further one is added


class SendWindow:
    """The sender's side; `size` unacknowledged messages are kept at most, fewer if they are large.

    sent          newest seq that was pushed
    acknowledged  newest seq that the receiver will not ask for again while it lives
    stored        newest seq that survives the receiver's death; below `acknowledged` while its disk cannot be written
    processed     newest seq that the receiver has processed
    """

    def __init__(self, channel: str, size: int, now: float) -> None:
        self.sent = self.acknowledged = self.stored = self.processed = 0
        self._channel, self._size = channel, size
        self._unacknowledged: deque[tuple[int, bytes]] = deque()  # oldest first
        self._bytes = 0  # their total size
        self._in_flight = 0  # how many of them were transmitted
        self._sent_before = 0  # newest seq that a sender before this one may have sent
        self._last_reply = now
        self._went_back = -math.inf  # when it last did, on the present connection

    def resume(self, seq: int, position: Position) -> None:
        """Continue after message `seq` of an earlier sender, of which the receiver is at `position`."""
        self.sent = self.acknowledged = self.processed = seq
        self.stored = min(seq, position.seq - position.in_memory)
        self._sent_before = position.processed + self._size  # a whole window of the earlier sender may be on its way

    @property
    def full(self) -> bool:
        """True if no message can be pushed now."""
        return len(self._unacknowledged) >= self._size or self._bytes >= _MOST_BYTES

    def push(self, seq: int, frame: bytes) -> None:
        """Accept the next message for transmission; ValueError if the window is full."""
        if self.full:
            waiting = f"{len(self._unacknowledged)} of {self._bytes} bytes"
            raise ValueError(f"message {seq} of {self._channel} was pushed while {waiting} are not acknowledged")
        self._unacknowledged.append((seq, frame))
        self._bytes += len(frame)
        self.sent = seq

    def transmit(self, send: Callable[[bytes], object]) -> None:
        """Send each frame that was not transmitted yet, until all were or `send` raises an error."""
        while self._in_flight < len(self._unacknowledged):
            send(self._unacknowledged[self._in_flight][1])
            self._in_flight += 1

    def must_ask(self, now: float) -> bool:
        """Return True if a question is due: messages wait, and the last reply or question is `PATIENCE_SECONDS` ago."""
        return bool(self._unacknowledged) and now - self._last_reply > PATIENCE_SECONDS

    def asked(self, now: float) -> None:
        """Note that the position was asked for."""
        self._last_reply = now

    def receive(self, position: Position, now: float) -> bool:
        """Process a reply; returns False, and changes nothing, if it is older than the last one.

        ProtocolError if the receiver has stored messages that were never sent, StreamRewoundError if it needs messages
        that it had acknowledged before, and that were dropped here.
        """
        if position.seq > max(self.sent, self._sent_before):
            raise ProtocolError(
                f"the receiver of {self._channel} has stored message {position.seq}, only {self.sent} were sent: "
                "it holds another stream: restart it, or start this process with --resume"
            )
        if position.again:
            if position.processed < self.acknowledged:
                raise StreamRewoundError(
                    f"the receiver of {self._channel} had {self.acknowledged} messages and now has "
                    f"{position.processed}: what came between is made again from the source"
                )
        elif position.seq < self.acknowledged or position.processed < self.processed:
            return False
        self._last_reply = now
        while self._unacknowledged and self._unacknowledged[0][0] <= position.seq:
            self._bytes -= len(self._unacknowledged.popleft()[1])
            self._in_flight = max(self._in_flight - 1, 0)
        self.acknowledged = max(self.acknowledged, min(position.seq, self.sent))
        self.stored = max(self.stored, min(position.seq - position.in_memory, self.sent))
        self.processed = min(position.processed, self.sent)
        if position.again and now - self._went_back > AGAIN_SECONDS:
            self._went_back = now
            self._in_flight = min(sum(seq <= position.processed for seq, _ in self._unacknowledged), self._in_flight)
        return True

    def disconnected(self) -> None:
        """The connection ended, and what was in flight may be lost."""
        self._went_back = -math.inf


class ReceiveWindow:
    """The receiver's side: the stream continues with the message after `position.processed`; the sender keeps `size`.

    processed      newest seq that was delivered; it is processed before `acknowledge` and the next `receive`
    ended      whether the sender has sent the end of the stream
    connected  whether the sender of the newest message was still connected when a message was last awaited
    peer       the sender of the newest message, to which acknowledgements go; None before the first
    """

    def __init__(self, position: Position, size: int) -> None:
        self.processed = position.processed
        self.ended = self.connected = False
        self.peer: bytes | None = None
        self._position, self._size = position, size
        self._bytes = 0  # total size of the messages that were delivered since all were stored
        self._gap_reported = -math.inf  # when a missing message was last reported

    @property
    def position(self) -> Position:
        """The reply to the sender of the last message."""
        return replace(self._position, processed=self.processed)

    @property
    def half_full(self) -> bool:
        """True if half of the sender's window is not stored yet: the sender waits while its window is full."""
        return 2 * (self.processed - self._position.seq) >= self._size or 2 * self._bytes >= _MOST_BYTES

    def asked(self, peer: bytes) -> Position:
        """The reply to a sender that asks for the position."""
        return self.position if peer == self.peer else replace(self.position, again=True)

    def receive(
        self, peer: bytes, seq: int, now: float, last: bool = False, size: int = 0
    ) -> tuple[bool, Position | None]:
        """A message of `size` bytes arrived; `last` says whether it is the end of the stream.

        Returns whether it is the next one, to be given to the application; and the reply to its sender, if any.
        """
        ends = last and not self.ended  # also before a restarted sender has repeated what was delivered
        if seq <= self.processed and not ends:  # retransmitted: the sender does not know that it arrived
            return False, self.position
        if seq <= self.processed + 1:
            self.processed, self.ended, self._bytes = max(seq, self.processed), last, self._bytes + size
            self.peer, self.connected, self._gap_reported = peer, True, -math.inf
            return True, None
        if now - self._gap_reported <= PATIENCE_SECONDS:
            return False, None
        self._gap_reported = now
        return False, replace(self.position, again=True)

    def acknowledge(self, position: Position) -> None:
        """All messages are processed; up to `position.seq`, except the last `in_memory` ones, they are stored."""
        self._position = position
        if position.seq >= self.processed:
            self._bytes = 0

    def disconnected(self) -> None:
        """A connection ended: it may be the sender's."""
        self.connected = False
