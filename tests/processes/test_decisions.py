"""Laws of the decisions, in histories without processes: where a detector continues, its waits, what is stored."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from catstream.base.box import Box, Window
from catstream.errors import ProtocolError
from catstream.processes.decisions import DesiredObject, DesiredState, TrainingLag, resume_at, stored, with_end
from catstream.wire.go_back_n import ReceiveWindow
from catstream.wire.messages import DetectorState, Position

BOX, PLACE = Box(1.0, 2.0, 30.0, 40.0), Window(40.0, 30.0, 20.0, 20.0)
STATE = DetectorState(0, "weak", PLACE, PLACE, PLACE)
NAMES = st.sampled_from(["", "anna", "ben"])
DESIRED = st.builds(
    DesiredState,
    st.dictionaries(NAMES, st.builds(DesiredObject, st.just(BOX), st.integers(1, 20), st.sampled_from(["", "digest"]))),
    st.booleans(),
    st.booleans(),
)
SEQ = st.integers(0, 20)
VERSIONS = st.dictionaries(NAMES, st.integers(1, 9))


@given(DESIRED)
def test_desired_state_is_read_as_it_was_written(tmp_path_factory, desired):
    file = tmp_path_factory.mktemp("state") / "desired_state.json"
    desired.save(file)
    assert DesiredState.load(file) == desired


@pytest.mark.parametrize("torn", ["", "{", "null", '{"objects": {"": [1, 2]}}'], ids=repr)
def test_torn_desired_state_is_an_error(tmp_path, torn):
    (tmp_path / "desired_state.json").write_text(torn)
    with pytest.raises(ProtocolError, match="cannot read the desired state"):
        DesiredState.load(tmp_path / "desired_state.json")


def test_desired_state_is_on_disk_before_it_replaces_another(tmp_path, monkeypatch):
    done = []
    for module, name in ((os, "fsync"), (Path, "replace")):
        call = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, call=call, name=name: (done.append(name), call(*given))[1])
    DesiredState(paused=True).save(tmp_path / "desired_state.json")
    assert done == ["fsync", "replace", "fsync"], "the file, and then its name"


@given(DESIRED, NAMES, st.integers(1, 30))
def test_objects_stay_in_the_order_of_their_beginning(desired, name, seq):
    others = [other for other in desired.objects if other != name]
    begun = desired.with_object(name, DesiredObject(BOX, seq))
    assert [*begun.objects] == [*others, name]
    assert [*begun.without(name).objects] == others


@given(DESIRED, SEQ, SEQ | st.none(), VERSIONS, st.sets(NAMES), st.booleans())
def test_restarted_detector_repeats_and_loses_no_frame(desired, processed, after, versions, known, live):
    position = Position(processed, processed, versions=versions, states=dict.fromkeys(known, STATE))
    start = resume_at(position, after, desired, live=live)
    assert start.seq <= processed, "the compressor has all messages before"
    assert start.repeats >= processed, "a command begins no object in a message that the compressor drops as a repeat"
    assert sorted(start.desired.objects) == sorted(desired.objects), "no object is lost"
    if live:
        assert start.seq == processed, "frames of a live source are not read again"
    else:
        assert after is None or start.seq <= after, "the program has all frames before"
        assert start.repeats >= (after or 0)
        if versions:
            assert start.seq == (processed if after is None else min(after, processed))
    for name, each in start.desired.objects.items():
        continues, begins = name in start.states, each.begins > start.seq
        assert continues != begins, "each object either continues with its state, or begins again"
        assert not continues or name in versions, "without a model there is nothing to continue with"
        assert replace(each, begins=0, box=BOX) == replace(desired.objects[name], begins=0, box=BOX)


def test_object_without_a_model_begins_again_at_its_last_box():
    desired = DesiredState({"anna": DesiredObject(BOX, 3), "ben": DesiredObject(BOX, 5)})
    position = Position(8, 8, versions={"anna": 2}, states={"anna": STATE, "ben": STATE})
    start = resume_at(position, 8, desired, live=False)
    assert start.states == {"anna": STATE}
    assert start.desired.objects["ben"] == DesiredObject(PLACE.box(), 9)


@given(st.lists(st.tuples(st.integers(1, 3), VERSIONS), max_size=20), SEQ)
def test_sample_counts_from_the_first_message_before_it(replies, seq):
    """Each reply is some messages after the one before."""
    lag, processed, led_to = TrainingLag(), 0, {}
    for messages, versions in replies:
        led_to |= dict.fromkeys(range(processed + 1, processed + messages + 1), versions)
        processed += messages
        lag.reply(processed, versions)
    assert lag.processed == processed
    assert lag.samples(min(seq, processed)) == led_to.get(min(seq, processed), {})
    assert lag.awaited(processed + 1, {}) == "features"


class Storing(RuleBasedStateMachine):
    """A receiver with a disk that fails now and then."""

    @initialize(seq=st.integers(0, 5))
    def begin(self, seq):
        self.position = Position(seq, seq)
        self.window = ReceiveWindow(self.position, 8)
        self.seq = self.on_disk = seq

    @rule(works=st.booleans(), due=st.booleans())
    def receive(self, works, due):
        self.seq += 1
        self.window.receive(b"peer", self.seq, 0.0)
        urgent = self.window.half_full
        if urgent or due:
            self.store(works, urgent)
        self.window.acknowledge(replace(self.position, processed=self.seq))

    @rule(works=st.booleans(), urgent=st.booleans())
    def store(self, works, urgent):
        self.on_disk = self.seq if works else self.on_disk
        self.position = stored(self.position, self.seq, saved=works, urgent=urgent)

    @invariant()
    def acknowledged_messages_are_on_disk_or_counted(self):
        position = self.position
        assert position.seq - position.in_memory == self.on_disk
        assert position.seq <= self.seq
        assert not self.window.half_full

    @invariant()
    def the_end_is_stored_as_much_as_the_message_before_it(self):
        ended = with_end(self.position, self.seq + 1)
        assert (ended.seq, ended.processed) == (self.seq + 1, self.seq + 1)
        assert ended.in_memory == (self.position.in_memory + 1 if self.position.in_memory else 0)
        assert with_end(self.position, self.position.seq) == self.position, "of a detector that repeats messages"


TestStoring = Storing.TestCase
TestStoring.settings = settings(max_examples=60)
