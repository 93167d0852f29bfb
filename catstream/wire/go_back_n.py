"""The acknowledged window: go-back-N retransmission as two state machines, without sockets and without a clock.

Inputs are events and the time in seconds; outputs are frames to transmit and replies. `catstream.wire.acknowledged`
connects the machines to sockets.

The sender numbers its messages 1, 2, 3 ... (`seq`). It keeps a copy of each until the receiver acknowledges it: at most
`size` copies, and no further one once they take 256 MiB. The receiver delivers each message to the application once and
in order. Once the application has processed it, the receiver replies with a `Position`, and the sender drops its copies
of stored messages.

If a message is missing, or if the position is requested on a new connection, the reply has `again` set: the sender
retransmits all messages after `processed`. A connection loses no message while it lasts, so the sender goes back only
once for several such replies. It requests the position after a restart, and after `PATIENCE_SECONDS` without a reply
while messages wait. Therefore each message is delivered once and in order although either side may be restarted, any
connection may break, and any reply may be lost. The end of the stream is delivered at any `seq` up to the next one: a
restarted sender may end before it has repeated all delivered messages.

A message may be acknowledged while it is only in memory, because the disk is not writable (`Position.in_memory`). If
such a receiver is restarted, the sender cannot retransmit the message and raises `StreamRewoundError`: it must produce
the messages again from the source.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from catstream.errors import ProtocolError, StreamRewoundError
from catstream.wire.messages import Position

PATIENCE_SECONDS = 0.2  #: timeout after which a request is repeated; minimum interval between reports of a gap
AGAIN_SECONDS = 2.0  #: minimum interval between two retransmissions of the window on one connection

_MOST_BYTES = 256 << 20  # total size of the copies above which the window is full


class SendWindow:
    """The sender's side, with at most `size` unacknowledged messages, fewer if they are large.

    sent          newest seq that was pushed
    acknowledged  newest seq that the receiver will not request again while it lives
    stored        newest seq that survives the receiver's death; below `acknowledged` while its disk is not writable
    processed     newest seq that the receiver has processed
    """

    def __init__(self, channel: str, size: int, now: float) -> None:
        self.sent = self.acknowledged = self.stored = self.processed = 0
        self._channel, self._size = channel, size
        self._unacknowledged: deque[tuple[int, bytes]] = deque()  # oldest first
        self._bytes = 0  # their total size
        self._in_flight = 0  # how many of them were transmitted
        self._sent_before = 0  # newest seq that an earlier sender may have sent
        self._last_reply = now
        self._went_back = -math.inf  # time of the last retransmission on the present connection

    def resume(self, seq: int, position: Position) -> None:
        """Continue after message `seq` of an earlier sender; `position` is the receiver's."""
        self.sent = self.acknowledged = self.processed = seq
        self.stored = min(seq, position.seq - position.in_memory)
        self._sent_before = position.processed + self._size  # the earlier sender may have had a full window in flight

    @property
    def full(self) -> bool:
        """True if no message can be pushed now."""
        return len(self._unacknowledged) >= self._size or self._bytes >= _MOST_BYTES

    def push(self, seq: int, frame: bytes) -> None:
        """Accept the next message for transmission; ValueError if the window is full."""
        if self.full:
            waiting = f"{len(self._unacknowledged)} of {self._bytes} bytes"
            raise ValueError(f"cannot push message {seq} of {self._channel}: {waiting} are not acknowledged")
        self._unacknowledged.append((seq, frame))
        self._bytes += len(frame)
        self.sent = seq

    def transmit(self, send: Callable[[bytes], object]) -> None:
        """Send the frames that were not transmitted yet, until `send` raises an error."""
        while self._in_flight < len(self._unacknowledged):
            send(self._unacknowledged[self._in_flight][1])
            self._in_flight += 1

    def must_ask(self, now: float) -> bool:
        """Return True if messages wait and the last reply or request is more than `PATIENCE_SECONDS` old."""
        return bool(self._unacknowledged) and now - self._last_reply > PATIENCE_SECONDS

    def asked(self, now: float) -> None:
        """Record the time of a request for the position."""
        self._last_reply = now

    def receive(self, position: Position, now: float) -> bool:
        """Process a reply; returns False, and changes nothing, if it is older than the last one.

        ProtocolError if the receiver has stored messages that were never sent, StreamRewoundError if it has lost
        messages that it had acknowledged.
        """
        if position.seq > max(self.sent, self._sent_before):
            raise ProtocolError(
                f"the receiver of {self._channel} has stored message {position.seq}, only {self.sent} were sent: "
                "it has the state of another stream; restart it, or start this process with --resume"
            )
        if position.again:
            if position.processed < self.acknowledged:
                raise StreamRewoundError(
                    f"the receiver of {self._channel} had {self.acknowledged} messages and now has "
                    f"{position.processed}: the others are produced again from the source"
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
        """Handle the end of the connection: messages in flight may be lost."""
        self._went_back = -math.inf


class ReceiveWindow:
    """The receiver's side: the stream continues after `position.processed`; `size` is the sender's.

    processed      newest seq that was delivered; it is processed before `acknowledge` and the next `receive`
    ended      whether the sender has sent the end of the stream
    connected  whether the sender of the newest message is connected, by the events handled so far
    peer       sender of the newest message, the recipient of acknowledgements; None before the first
    """

    def __init__(self, position: Position, size: int) -> None:
        self.processed = position.processed
        self.ended = self.connected = False
        self.peer: bytes | None = None
        self._position, self._size = position, size
        self._bytes = 0  # total size of the messages delivered since all were stored
        self._gap_reported = -math.inf  # time of the last report of a missing message

    @property
    def position(self) -> Position:
        """The reply to the sender of the last message."""
        return replace(self._position, processed=self.processed)

    @property
    def half_full(self) -> bool:
        """True if half of the sender's window is not stored yet: the sender waits while its window is full."""
        return 2 * (self.processed - self._position.seq) >= self._size or 2 * self._bytes >= _MOST_BYTES

    def asked(self, peer: bytes) -> Position:
        """The reply to a sender that requests the position."""
        return self.position if peer == self.peer else replace(self.position, again=True)

    def receive(
        self, peer: bytes, seq: int, now: float, last: bool = False, size: int = 0
    ) -> tuple[bool, Position | None]:
        """Process a message of `size` bytes; `last` marks the end of the stream.

        Returns whether to deliver it to the application, and the reply to its sender, if any.
        """
        ends = last and not self.ended  # even if a restarted sender has not repeated all delivered messages
        if seq <= self.processed and not ends:  # a repeat: the sender has not received the acknowledgement
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
        """Set the position: messages up to `seq` are stored, except the last `in_memory` ones; all are processed."""
        self._position = position
        if position.seq >= self.processed:
            self._bytes = 0

    def disconnected(self) -> None:
        """Handle the end of a connection, possibly the sender's."""
        self.connected = False
