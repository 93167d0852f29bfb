"""Laws of resuming: the point from which the detectors continue, for all answers of the other processes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from catstream.box import Box, Window
from catstream.messages.kinds import DetectorState, Model, ObjectPosition, Position
from catstream.services.desired import DesiredObject, DesiredState
from catstream.services.resume import agree, start

BOX = Box(1.0, 2.0, 30.0, 40.0)
STATE = DetectorState(0, "confident", *3 * (Window(*BOX),))

names = st.sampled_from(["", "anna", "ben"])
seqs = st.integers(0, 50)
versions = st.integers(0, 9)
parts = st.builds(ObjectPosition, st.none() | st.just(BOX), versions, st.none() | st.just(STATE))
positions = st.builds(Position, seq=seqs, objects=st.dictionaries(names, parts))
made = st.builds(Model, versions.filter(bool), seqs, st.just(np.empty(0, np.float32)), st.just(0.0))
models = st.dictionaries(names, made)
objects = st.builds(DesiredObject, st.just(BOX), seqs.filter(bool), st.sampled_from(["", "a saved model"]))
states = st.builds(DesiredState, st.dictionaries(names, objects))
histories = st.tuples(st.lists(positions, min_size=1, max_size=2), models, states)


def begin(history):
    received, model, desired = history
    return start(received, model, desired, lambda _box, _first, _began: STATE)


@given(histories)
def test_no_receiver_misses_a_message(history):
    received, _, desired = history
    first = begin(history).seq + 1
    assert all(first <= position.seq + 1 for position in received)
    assert first >= 1
    begun = {each.begins for each in desired.objects.values()}
    assert first in {min(position.seq for position in received) + 1, *begun}


@given(histories)
def test_a_detector_state_is_resumed_only_with_the_model_of_its_object_and_after_the_object_has_begun(history):
    received, learned, desired = history
    found = begin(history)
    for name, (_, model) in found.objects.items():
        assert model is learned[name]
        assert received[0].versions
        assert found.seq >= desired.objects[name].begins


@given(histories)
def test_every_object_that_was_wanted_is_still_wanted_and_continues_or_begins_later(history):
    received, _, desired = history
    found = begin(history)
    assert found.desired.objects.keys() == desired.objects.keys()
    for name, each in found.desired.objects.items():
        assert name in found.objects or each.begins > found.seq or (each.model and name in received[0].objects)


@given(histories)
def test_if_nothing_was_learned_of_any_object_all_begin_at_their_first_frames(history):
    received, _, desired = history
    if not received[0].versions and desired.objects:
        found = begin(history)
        assert found.seq < min(each.begins for each in found.desired.objects.values())
        assert not found.objects


@given(histories)
def test_compressor_and_trainer_agree_once_the_model_of_every_sample_is_here(history):
    received, learned, desired = history
    last = min(position.seq for position in received)
    there = {name for name, each in desired.objects.items() if each.begins <= last}
    expected = all(
        name in learned and learned[name].version == version
        for name, version in received[0].versions.items()
        if name in there
    )
    assert agree(received, learned, desired) == expected


def test_a_state_that_is_not_stored_is_made_of_the_last_and_the_first_box():
    model = Model(1, 5, np.empty(0, np.float32), 0.0)
    made = []
    last, first = Box(5.0, 6.0, 30.0, 40.0), BOX

    def state_at(*boxes):
        made.append(boxes)
        return STATE

    position = Position(5, 4, {"anna": ObjectPosition(last, 1)})
    found = start([position], {"anna": model}, DesiredState({"anna": DesiredObject(first, begins=1)}), state_at)
    assert (found.seq, found.objects, made) == (5, {"anna": (STATE, model)}, [(last, first, 0)])


def test_an_object_that_had_learned_nothing_beside_another_begins_anew_where_it_was_last():
    model = Model(1, 5, np.empty(0, np.float32), 0.0)
    last = Box(5.0, 6.0, 30.0, 40.0)
    position = Position(5, 4, {"anna": ObjectPosition(BOX, 1, STATE), "ben": ObjectPosition(last)})
    desired = DesiredState({name: DesiredObject(BOX, begins=2) for name in ("anna", "ben")})
    found = start([position], {"anna": model}, desired, lambda _box, _first, _began: STATE)
    assert found.objects == {"anna": (STATE, model)}
    assert found.desired.objects["ben"] == DesiredObject(last, begins=6)


def test_an_object_that_was_forgotten_later_continues_until_then_in_the_order_of_the_trees():
    model = Model(1, 5, np.empty(0, np.float32), 0.0)
    parts = {"anna": ObjectPosition(BOX, 1, STATE), "ben": ObjectPosition(BOX, 1, STATE)}
    desired = DesiredState().begun("anna", BOX, 1).begun("ben", BOX, 2).without("anna", 8).begun("anna", BOX, 9)
    found = start([Position(5, 4, parts)], dict.fromkeys(parts, model), desired, lambda _box, _first, _began: STATE)
    assert list(found.objects) == ["anna", "ben"]
    assert found.desired == desired
    assert list(desired.objects_at(8)) == ["anna", "ben"]
    assert desired.objects_at(9)["anna"].begins == 9
