"""Laws of storing: what a sender may forget is on disk, or is counted as unsaved; its window never stays full."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from catstream.messages.kinds import End, ObjectPosition, Position
from catstream.services.stored_part import StoredPart
from catstream.wire.go_back_n import ReceiveWindow

WINDOW = 8
WINDOW_BYTES = 256 << 20
INTERVAL = 3.0


def objects(version):
    """The part of a position for one object."""
    return {"anna": ObjectPosition(version=version)}


class Storing(RuleBasedStateMachine):
    """A receiver with a disk that fails now and then."""

    def __init__(self):
        super().__init__()
        self.part = StoredPart(Position(5), 0.0)
        self.window = ReceiveWindow(Position(5), WINDOW)
        self.seq = self.on_disk = 5
        self.now, self.unstored = 0.0, 0

    def store(self, works, urgent, seconds=0.0):
        if works:
            self.on_disk = self.seq
        position = Position(self.seq, objects=objects(self.seq))
        began, self.now = self.now, self.now + seconds
        self.part = self.part.after(position, began, self.now, saved=works, urgent=urgent)
        self.window.acknowledge(self.part.position)
        self.unstored = 0 if self.part.position.seq == self.seq else self.unstored

    @rule(works=st.booleans(), size=st.integers(0, WINDOW_BYTES // 3))
    def receive(self, works, size):
        self.seq += 1
        self.unstored += size
        self.window.receive(b"peer", self.seq, self.now, size=size)
        urgent = self.window.half_full
        if urgent or self.part.is_due(self.seq, self.now, INTERVAL):
            self.store(works, urgent)

    @rule(works=st.booleans(), seconds=st.floats(0, 2 * INTERVAL), duration=st.floats(0, INTERVAL))
    def time_passes(self, works, seconds, duration):
        self.now += seconds
        if self.part.is_due(self.seq, self.now, INTERVAL):
            assert self.now - self.part.tried >= INTERVAL
            assert self.part.took <= (self.now - self.part.tried + self.part.took) / 10 + 1e-9
            self.store(works, False, duration)
            assert not self.part.is_due(self.seq, self.now, INTERVAL)

    @rule(works=st.booleans())
    def a_sender_asks(self, works):
        self.store(works, urgent=True)
        assert self.part.position.seq == self.seq

    @invariant()
    def what_a_sender_may_forget_is_on_disk_or_counted(self):
        position = self.part.position
        assert self.part.stored == self.on_disk
        assert position.seq - position.unsaved <= self.on_disk
        assert self.on_disk <= self.seq or position.unsaved == 0

    @invariant()
    def half_of_the_window_is_free(self):
        assert 2 * (self.seq - self.part.position.seq) < WINDOW
        assert 2 * self.unstored < WINDOW_BYTES

    @invariant()
    def the_end_is_stored_as_much_as_the_message_before_it(self):
        now = Position(self.seq, objects=objects(9))
        acknowledged = self.part.acknowledgement(now, End(self.seq + 1, "it ended"))
        position = self.part.position
        assert (acknowledged.seq, acknowledged.versions) == (self.seq + 1, {"anna": 9})
        assert acknowledged.unsaved == (position.unsaved + 1 if position.unsaved else 0)
        assert self.part.acknowledgement(now, None).seq == position.seq

    @invariant()
    def the_end_of_a_detector_that_repeats_messages_changes_nothing(self):
        """It failed before it had repeated all that was received."""
        position = self.part.position
        assert self.part.acknowledgement(position, End(position.seq, "it failed")) == position


TestStoring = Storing.TestCase


@given(took=st.integers(0, 60), interval=st.integers(1, 20), later=st.integers(0, 1000))
def test_at_most_a_tenth_of_the_time_is_spent_writing(took, interval, later):
    part = StoredPart(Position(1), 0.0).after(Position(2), 100.0, 100.0 + took, saved=True, urgent=False)
    due = part.is_due(3, 100.0 + took + later, interval)
    assert due == (later >= interval and took * 10 <= took + later)
