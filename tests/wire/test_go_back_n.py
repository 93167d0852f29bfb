"""The acknowledged window in random histories: each message is processed once and in order, also after restarts.

No process, no socket, no clock: the two state machines, a network that breaks and repeats frames, and a disk.
"""

from collections import deque
from dataclasses import replace
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from catstream.errors import ProtocolError, StreamRewoundError
from catstream.wire.go_back_n import PATIENCE_SECONDS, ReceiveWindow, SendWindow
from catstream.wire.messages import Position

STRANGER = b"stranger"
ASKS = b""  # the frame by which a sender asks for the position


def payload(seq):
    """The content of message `seq`."""
    return b"message %d" % seq


def made_by(seq):
    """The version of the newest sample of each object after message `seq`; ben is forgotten now and then."""
    versions = {}
    for number in range(1, seq + 1):
        versions |= {1: {"anna": number}, 2: {"ben": number}}.get(number % 3, {})
        if number % 7 == 0:
            versions.pop("ben", None)
    return versions


class Histories(RuleBasedStateMachine):
    """A sender, a receiver with a disk, and the connection between them, which keeps order while it lasts."""

    @initialize(size=st.integers(1, 6))
    def begin(self, size):
        self.size, self.now, self.senders = size, 0.0, 0
        self.to_receiver, self.to_sender = deque(), deque()
        self.disk = self.promised = 0  # newest seq on disk; newest seq that was ever reported as stored
        self.connections = 0
        self.full, self.in_memory = False, False  # the disk takes nothing; messages were acknowledged nevertheless
        self.position = Position()
        self.receiver = ReceiveWindow(self.position, size)
        self.start_sender()

    def start_sender(self):
        self.senders += 1
        self.connect()
        self.sender, self.resumed = SendWindow("features", self.size, self.now), self.senders == 1

    def connect(self):
        """Each connection counts as another peer."""
        self.connections += 1
        self.peer = b"connection %d" % self.connections

    # The steps of `Sender` and `Receiver`.

    def push(self):
        """Push the next message if there is room."""
        seq = self.sender.sent + 1
        if seq - self.sender.acknowledged <= self.size:
            self.sender.push(seq, payload(seq))
        else:
            with pytest.raises(ValueError, match="not acknowledged"):
                self.sender.push(seq, payload(seq))

    def transmit(self):
        self.sender.transmit(lambda frame: self.to_receiver.append((self.peer, frame)))

    def reply(self, peer, position):
        if position is not None and peer == self.peer:
            self.to_sender.append(position)

    def acknowledge(self):
        self.receiver.acknowledge(self.position)
        self.reply(self.receiver.peer, self.receiver.position)

    def store(self):
        """Write a checkpoint, if the disk takes it."""
        if not self.full:
            self.disk = self.receiver.processed
        self.in_memory |= self.receiver.processed > self.disk
        processed = self.receiver.processed
        self.position = Position(processed, processed, processed - self.disk, made_by(processed))

    def arrives(self, peer, frame):
        """A frame arrives at the receiver, which takes a message only if it is the next one."""
        if frame == ASKS:
            self.reply(peer, self.receiver.asked(peer))
            return
        seq, before = int(frame.split()[1]), self.receiver.processed
        delivered, reply = self.receiver.receive(peer, seq, self.now)
        self.reply(peer, reply)
        if delivered:
            assert (seq, self.receiver.processed) == (before + 1, before + 1)
            self.position = replace(self.position, versions=made_by(seq))
            self.acknowledge()
        else:
            assert self.receiver.processed == before

    def replied(self, message):
        """A reply arrives at the sender."""
        if not self.resumed:
            if message.again:
                self.sender.resume(message.processed, message)
                self.resumed = True
            return
        try:
            assert self.sender.receive(message, self.now) or not message.again
        except StreamRewoundError:
            if not self.in_memory:
                assert self.senders > 1, "only a sender that was restarted lacks what the receiver has not stored yet"
            self.sender_dies()

    # Events.

    @rule()
    def send(self):
        if self.resumed:
            self.push()
            self.transmit()

    @rule()
    def send_without_a_connection(self):
        if self.resumed:
            self.push()

    @rule(seconds=st.sampled_from([0.01, PATIENCE_SECONDS / 2, 2 * PATIENCE_SECONDS]))
    def time_passes(self, seconds):
        self.now += seconds
        if not self.resumed or self.sender.must_ask(self.now):
            self.sender.asked(self.now)
            self.to_receiver.append((self.peer, ASKS))
        self.transmit()

    @precondition(lambda self: self.to_receiver)
    @rule(twice=st.booleans())
    def frame_arrives(self, twice):
        peer, frame = self.to_receiver.popleft()
        for _ in range(1 + twice):
            self.arrives(peer, frame)

    @precondition(lambda self: self.to_sender)
    @rule(twice=st.booleans())
    def reply_arrives(self, twice):
        message = self.to_sender.popleft()
        for _ in range(1 + twice):
            self.replied(message)
        self.transmit()

    @rule(transmitted=st.integers(0, 3))
    def connection_breaks(self, transmitted):
        """The frames that were not transmitted by then are lost, and all replies."""
        self.to_receiver = deque(list(self.to_receiver)[:transmitted])
        self.to_sender.clear()
        self.sender.disconnected()
        self.connect()

    @precondition(lambda self: self.to_sender)
    @rule()
    def reply_is_lost(self):
        self.to_sender.popleft()

    @rule(full=st.booleans())
    def receiver_stores(self, full):
        """Or tries to: the disk may be full."""
        self.full = full
        self.store()
        self.acknowledge()

    @rule()
    def receiver_dies(self):
        self.to_receiver.clear()
        self.to_sender.clear()
        self.position = Position(self.disk, self.disk, versions=made_by(self.disk))
        self.receiver = ReceiveWindow(self.position, self.size)
        self.sender.disconnected()
        self.connect()

    @rule()
    def sender_dies(self):
        """Its transmitted frames may still arrive."""
        self.to_sender.clear()
        self.start_sender()

    @rule(seq=st.integers(0, 50))
    def stranger_repeats_a_frame(self, seq):
        if seq <= self.receiver.processed:  # one that is not of the stream is rejected before it is counted
            self.arrives(STRANGER, payload(seq) if seq else ASKS)

    # Invariants.

    @invariant()
    def the_window_is_never_exceeded(self):
        if self.senders:
            copies = [frame for _, frame in self.sender._unacknowledged]
            assert len(copies) <= self.size
            assert copies == [payload(seq) for seq in range(self.sender.sent - len(copies) + 1, self.sender.sent + 1)]
            assert self.sender._in_flight <= len(copies)

    @invariant()
    def messages_reported_as_stored_are_on_disk(self):
        if self.senders and self.resumed:
            self.promised = max(self.promised, self.sender.stored)
            assert self.promised <= self.disk

    @invariant()
    def counts_are_in_order(self):
        if self.senders and self.resumed:
            assert self.sender.stored <= self.sender.acknowledged <= self.sender.processed <= self.sender.sent

    def teardown(self):
        """Once nothing is lost any more, everything that was sent is processed and stored."""
        if not self.senders:
            return
        for _ in range(20):
            self.time_passes(2 * PATIENCE_SECONDS)
            while self.to_receiver or self.to_sender:
                if self.to_receiver:
                    self.frame_arrives(twice=False)
                if self.to_sender:
                    self.reply_arrives(twice=False)
            self.receiver_stores(full=False)
        assert self.resumed
        assert self.receiver.processed >= self.sender.sent
        assert self.sender.acknowledged == self.sender.processed == self.sender.sent
        assert not self.sender._unacknowledged


TestHistories = Histories.TestCase
TestHistories.settings = settings(max_examples=150, stateful_step_count=60)


@given(processed=st.integers(0, 5), seq=st.integers(1, 9))
def test_end_is_delivered_once_at_any_number_up_to_the_next(processed, seq):
    """A restarted sender may end before it has repeated what was delivered; a gap before the end is asked for."""
    receiver = ReceiveWindow(Position(processed, processed), 4)
    delivered, _ = receiver.receive(b"restarted", seq, 1.0, last=True)
    assert delivered == receiver.ended == receiver.connected == (seq <= processed + 1)
    assert receiver.processed == (max(seq, processed) if delivered else processed)
    receiver.acknowledge(Position(receiver.processed))
    again, reply = receiver.receive(b"restarted", seq, 2.0, last=True)
    assert not again
    if delivered:
        assert reply.seq >= seq, "the sender knows that it arrived"


def filled(size, count):
    """A sender that has transmitted so many messages."""
    window = SendWindow("features", size, 0.0)
    for seq in range(1, count + 1):
        window.push(seq, payload(seq))
    assert len(frames(window)) == count
    return window


def frames(window):
    """The frames that a sender transmits now."""
    sent = []
    window.transmit(sent.append)
    return sent


def test_sender_accepts_no_message_beyond_256_mib():
    window, large = SendWindow("features", 9, 0.0), bytes(64 << 20)
    for seq in range(1, 5):
        assert not window.full
        window.push(seq, large)
    with pytest.raises(ValueError, match="4 of 268435456 bytes are not acknowledged"):
        window.push(5, b"")
    window.receive(Position(1, 1), now=0.0)
    window.push(5, bytes(300 << 20))
    window.receive(Position(4, 4), now=0.0)
    assert window.full
    window.receive(Position(5, 5), now=0.0)
    assert not window.full


def test_frame_that_the_socket_rejects_is_transmitted_again():
    window = filled(size=4, count=0)
    window.push(1, payload(1))
    window.push(2, payload(2))
    with pytest.raises(BlockingIOError):
        window.transmit(Mock(side_effect=[None, BlockingIOError]))
    assert frames(window) == [payload(2)]
    assert frames(window) == []


def test_missing_message_is_reported_at_once_and_then_rarely():
    window = ReceiveWindow(Position(), size=8)
    assert window.receive(b"peer", 2, now=0.0) == (False, Position(again=True))
    assert window.receive(b"peer", 1, now=0.0) == (True, None)
    report = (False, Position(0, 1, again=True))
    assert window.receive(b"peer", 3, now=0.0) == report, "another gap"
    assert window.receive(b"peer", 4, now=PATIENCE_SECONDS) == (False, None)
    assert window.receive(b"peer", 5, now=PATIENCE_SECONDS + 0.01) == report


def test_sender_goes_back_once_on_each_connection():
    window = filled(size=5, count=5)
    window.receive(Position(2, 3, again=True), now=1.0)
    assert frames(window) == [payload(4), payload(5)]
    window.receive(Position(2, 3, again=True), now=1.3)
    assert frames(window) == []
    window.disconnected()
    window.receive(Position(2, 2, again=True), now=1.6)
    assert frames(window) == [payload(3), payload(4), payload(5)]


def test_sender_asks_only_while_messages_wait():
    window = SendWindow("features", 4, now=0.0)
    assert not window.must_ask(99.0)
    window.push(1, payload(1))
    assert window.must_ask(99.0)
    window.asked(99.0)
    assert [window.must_ask(now) for now in (99.1, 99.15, 99.3)] == [False, False, True]
    window.push(2, payload(2))
    window.receive(Position(1, 1), now=99.4)
    assert [window.must_ask(now) for now in (99.55, 99.65)] == [False, True]
    window.receive(Position(2, 2), now=99.7)
    assert not window.must_ask(200.0)


@pytest.mark.parametrize("late", [Position(1, 3), Position(2, 2)], ids=["stored less", "received less"])
def test_acknowledgement_that_steps_back_is_ignored(late):
    window = filled(size=4, count=4)
    window.receive(Position(2, 3), now=0.0)
    assert not window.receive(late, now=50.0)
    assert (window.acknowledged, window.stored, window.processed) == (2, 2, 3)
    assert window.must_ask(50.0), "it is no sign of life"


def test_messages_in_memory_are_acknowledged_but_not_stored():
    window = filled(size=4, count=3)
    window.receive(Position(3, 3, in_memory=2), now=0.0)
    assert (window.acknowledged, window.stored) == (3, 1)
    window.push(4, payload(4))
    with pytest.raises(StreamRewoundError, match="had 3 messages and now has 1"):
        window.receive(Position(1, 1, again=True), now=0.0)


def test_sender_detects_the_receiver_of_another_stream():
    window = SendWindow("features", 4, now=0.0)
    window.resume(3, Position(5, 5))
    window.receive(Position(9, 9), now=0.0)
    assert (window.acknowledged, window.stored, window.processed) == (3, 3, 3)
    with pytest.raises(ProtocolError, match="another stream"):
        window.receive(Position(10, 10), now=0.0)
